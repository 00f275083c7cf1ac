"""Inputs as the sensors ask for them within their noise, and laws along the motion that results.

What a step of the optimiser needs besides the point is one value, `Working`: it is made here, passed on and replaced.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.problem import Problem, SmoothedInputs
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.harmonic_balance import HarmonicBalance, LawForces, fixed_point
from sprung.model.diagnosis.response.point import Point
from sprung.model.signals import FloatArray

_FOLLOWED = 1e-4  # of the laws' forces along a smoothed motion, which is no better known
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding
_WIDTH = 21  # bins over which the residual's level is averaged


@dataclass(frozen=True)
class Working:
    """How residuals are weighed at a point, and the inputs that its model is driven by; None: as measured."""

    whitener: Whitener
    inputs: SmoothedInputs | None = None
    plant: Plant | None = None  # that inputs were smoothed through


def opened(problem: Problem, point: Point, whitener: Whitener | None = None) -> tuple[Point, Working]:
    """A point and what its residual is weighed by, before any residual is known."""
    if problem.process_noise:
        return along_measured_motion(problem, point)
    return point, Working(whitener or Whitener.of(problem.forward(point), problem.noise))


def smoothed(problem: Problem, point: Point, working: Working, spectrum: ComplexArray) -> tuple[Point, Working]:
    """Smooth the inputs at a point near the last one, whose residual was `spectrum` (F, S).

    What of the residual the inputs' noise explains is taken for it.  Returns the point, where the system has measured
    forces with its starting state fitted anew.
    """
    if problem.process_noise:
        return along_measured_motion(problem, point)
    # the noise of supports is small: the last residual tells it well enough
    return point, replace(working, inputs=SmoothedInputs(_smoothed(problem.part, working.whitener, spectrum)))


def along_measured_motion(problem: Problem, point: Point) -> tuple[Point, Working]:
    """Smooth measured forces, with laws along the motion that results.

    A measured force accounts for whatever else pushes the body, so its noise is large and the smoothed
    motion is the one that the sensors saw, not a free run.  Laws' forces, state and smoothed inputs depend on each
    other; they are iterated like the forces of a free run.
    """
    part = problem.part
    forward = problem.forward(replace(point, warm_start=()))
    whitener = Whitener.of(forward, problem.noise)  # noise goes through the plant as it is now
    free = problem.free_columns(forward)
    columns = whitener(free, part)
    scale = scale_of(columns.T @ columns, columns.shape[1])
    of_residual = scale[:, None] * np.linalg.pinv(columns * scale, rcond=1e-9)

    def explained(forces: LawForces | None) -> tuple[FloatArray, Part]:
        spectrum = part.sensors - problem.shown(forward, forces)
        state = of_residual @ whitener(spectrum, part)
        return state, _smoothed(part, whitener, spectrum - free @ state)

    balance = forward.harmonic_balance(point.state)
    if balance is None:
        state, inputs = explained(None)
        return replace(point, state=state), Working(whitener, SmoothedInputs(inputs), forward.plant)

    def along(force: FloatArray, balance: HarmonicBalance = balance) -> FloatArray:
        state, inputs = explained(balance.solution(force))
        driven = balance.under(forward.with_part(inputs).fine_motion(balance.ports, state))
        return driven.law_forces(*driven.motion(force))

    start = (
        np.column_stack(point.warm_start)
        if point.warm_start
        else along(np.zeros((len(balance.d0), len(balance.terms))))
    )
    force, _ = fixed_point(along, start, _FOLLOWED)
    state, inputs = explained(balance.solution(force))
    working = Working(whitener, SmoothedInputs(inputs, force), forward.plant)
    return replace(point, state=state, warm_start=tuple(force.T)), working


def _smoothed(part: Part, whitener: Whitener, spectrum: ComplexArray) -> Part:
    """The part with its inputs as a residual (F, S) asks for."""
    band = part.grid.band
    whitened = (whitener.factor @ spectrum[band, :, None])[:, :, 0]
    size = np.mean(np.abs(whitened) ** 2, axis=1)
    local = np.convolve(np.pad(size, _WIDTH // 2, mode="edge"), np.ones(_WIDTH) / _WIDTH, mode="valid")
    shift = np.einsum("fis,fs->fi", whitener.smoother_gain, whitened)
    support, force = part.support.copy(), part.force.copy()
    count = support.shape[1]
    support[band] += shift[:, :count] / np.maximum(1.0, local)[:, None]
    force[band] += shift[:, count:]
    steady = part.force_polynomial.copy()  # moves a floating system steadily, which its spectrum cannot
    steady[0] += np.real(force[0] - part.force[0]) / np.sqrt(part.grid.samples)
    force[0] = part.force[0]
    return replace(part, support=support, force=force, force_polynomial=steady)


def scale_of(normal: FloatArray, states: int) -> FloatArray:
    """What brings the diagonal of normal equations to one; zero for what leaves no trace, which then stays as it is.

    Where a body floats, its starting position, among the states at the end, leaves none in rates and accelerations.
    """
    size = np.diag(normal)
    seen = size > 0
    seen[-states:] = size[-states:] > _UNSEEN * size[-states:].max()
    return np.where(seen, 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
