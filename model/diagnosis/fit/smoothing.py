"""Inputs as the sensors ask for them within their noise, and laws along the motion that results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, Loop, fixed_point
from sprung.model.diagnosis.response.point import Point
from sprung.model.signals import FloatArray

if TYPE_CHECKING:
    from sprung.model.diagnosis.fit.jacobian import Linearisation
    from sprung.model.diagnosis.fit.problem import Problem

_FOLLOWED = 1e-4  # of the laws' forces along a smoothed motion, which is no better known
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding


@dataclass(frozen=True)
class Smoothed:
    """Inputs as the sensors ask for them within their noise."""

    part: Part
    force: FloatArray | None = None  # of the laws along the motion that results, (4N, m)


def smooth(problem: Problem, point: Point, last: Linearisation | None = None) -> Point:
    """Smooth the inputs at a point near the last one: what of the residual their noise explains is taken for it.

    Returns the point, where the system has measured forces with its starting state fitted anew.
    """
    if problem.follows:
        return _along_measured_motion(problem, point)
    if last is not None:  # the noise of supports is small: the last residual tells it well enough
        problem.smoothed = Smoothed(_smoothed(problem, last.spectrum))
    return point


def _along_measured_motion(problem: Problem, point: Point) -> Point:
    """Smooth measured forces, with laws along the motion that results.

    A measured force takes the blame for whatever else pushes the body, so its noise is large and the smoothed
    motion is the one that the sensors saw, not a free run.  Laws' forces, state and smoothed inputs depend on each
    other; they are iterated like the forces of a free run.
    """
    part = problem.part
    forward = Forward(problem.system, part, problem.sensors, point.theta, point.terms)
    problem.whitener = whitener = Whitener.of(forward, problem.noise)  # noise goes through the plant as it is now
    free = problem.free_columns(forward)
    columns = whitener(free, part)
    scale = scale_of(columns.T @ columns, columns.shape[1])
    of_residual = scale[:, None] * np.linalg.pinv(columns * scale, rcond=1e-9)

    def smoothed(forces: LawForces | None) -> tuple[FloatArray, Part]:
        spectrum = part.sensors - problem.shown(forward, forces)
        state = of_residual @ whitener(spectrum, part)
        return state, _smoothed(problem, spectrum - free @ state)

    loop = forward.loop(point.state)
    if loop is None:
        state, inputs = smoothed(None)
        problem.smoothed = Smoothed(inputs)
        return replace(point, state=state)

    def along(force: FloatArray, loop: Loop = loop) -> FloatArray:
        state, inputs = smoothed(loop.answer(force))
        driven = loop.driven(forward.driven_by(inputs), state)
        return driven.law(*driven.motion(force))

    start = np.column_stack(point.near) if point.near else along(np.zeros((len(loop.d0), len(loop.terms))))
    force, _ = fixed_point(along, start, _FOLLOWED)
    state, inputs = smoothed(loop.answer(force))
    problem.smoothed = Smoothed(inputs, force)
    return replace(point, state=state, near=tuple(force.T))


def _smoothed(problem: Problem, spectrum: ComplexArray) -> Part:
    """The part with its inputs as a residual (F, S) asks for."""
    assert problem.whitener is not None
    part, band = problem.part, problem.part.grid.band
    whitened = (problem.whitener.factor @ spectrum[band, :, None])[:, :, 0]
    size = np.mean(np.abs(whitened) ** 2, axis=1)
    width = 21
    local = np.convolve(np.pad(size, width // 2, mode="edge"), np.ones(width) / width, mode="valid")
    shift = np.einsum("fis,fs->fi", problem.whitener.blame, whitened)
    support, force = part.support.copy(), part.force.copy()
    count = support.shape[1]
    support[band] += shift[:, :count] / np.maximum(1.0, local)[:, None]
    force[band] += shift[:, count:]
    steady = part.force_polynomial.copy()  # moves a floating system steadily, which its spectrum cannot
    steady[0] += np.real(force[0] - part.force[0]) / np.sqrt(part.grid.samples)
    force[0] = part.force[0]
    return replace(part, support=support, force=force, force_polynomial=steady)


def scale_of(normal: FloatArray, states: int) -> FloatArray:
    """What brings the diagonal of normal equations to one; zero for a state at the end of it that leaves no trace.

    Where a body floats, its starting position leaves none in rates and accelerations.
    """
    size = np.diag(normal)
    seen = np.ones(len(size), dtype=bool)
    seen[-states:] = size[-states:] > _UNSEEN * size[-states:].max()
    return np.where(seen, 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
