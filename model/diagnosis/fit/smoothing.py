"""Smoothing of the inputs within their noise, with laws along the smoothed motion.

Beside the point, a step of the optimiser needs one value, `Working`: weights and smoothed inputs.
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

_FOLLOWED = 1e-4  # relative tolerance of the laws' forces along a smoothed motion
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding
_WIDTH = 21  # bins over which the residual's level is averaged


@dataclass(frozen=True)
class Working:
    """Weights of the residual at a point, and the inputs of its model; None: as measured."""

    whitener: Whitener
    inputs: SmoothedInputs | None = None
    plant: Plant | None = None  # of the smoother


def opened(problem: Problem, point: Point, whitener: Whitener | None = None) -> tuple[Point, Working]:
    """A point and the weights of its residual, before the first evaluation."""
    if problem.process_noise:
        return along_measured_motion(problem, point)
    return point, Working(whitener or Whitener.of(problem.forward(point), problem.noise))


def smoothed(problem: Problem, point: Point, working: Working, spectrum: ComplexArray) -> tuple[Point, Working]:
    """Smooth the inputs at a point near the last one, whose residual was `spectrum` (F, S).

    Returns the point and its weights; in systems with measured forces the initial state is fitted anew.
    """
    if problem.process_noise:
        return along_measured_motion(problem, point)
    # the noise of supports is small: the last residual is accurate enough
    return point, replace(working, inputs=SmoothedInputs(_smoothed(problem.part, working.whitener, spectrum)))


def along_measured_motion(problem: Problem, point: Point) -> tuple[Point, Working]:
    """Smooth measured forces, with laws along the motion that results.

    A measured force stands for all other forces on the body, so its noise is large, and the smoothed motion is close
    to the measured one rather than a free run.  Laws' forces, state and smoothed inputs depend on each other and are
    found by fixed-point iteration.
    """
    part = problem.part
    forward = problem.forward(replace(point, warm_start=()))
    whitener = Whitener.of(forward, problem.noise)  # of the present plant
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
    """The part with inputs smoothed by a residual (F, S)."""
    band = part.grid.band
    whitened = (whitener.factor @ spectrum[band, :, None])[:, :, 0]
    size = np.mean(np.abs(whitened) ** 2, axis=1)
    local = np.convolve(np.pad(size, _WIDTH // 2, mode="edge"), np.ones(_WIDTH) / _WIDTH, mode="valid")
    shift = np.einsum("fis,fs->fi", whitener.smoother_gain, whitened)
    support, force = part.support.copy(), part.force.copy()
    count = support.shape[1]
    support[band] += shift[:, :count] / np.maximum(1.0, local)[:, None]
    force[band] += shift[:, count:]
    steady = (
        part.force_polynomial.copy()
    )  # accelerates unconstrained systems steadily, which a spectrum cannot represent
    steady[0] += np.real(force[0] - part.force[0]) / np.sqrt(part.grid.samples)
    force[0] = part.force[0]
    return replace(part, support=support, force=force, force_polynomial=steady)


def scale_of(normal: FloatArray, states: int) -> FloatArray:
    """Scales (p,) that make the diagonal of normal equations one; zero for unobservable values, which stay constant.

    The initial position of an unconstrained body, one of the `states` last values, is unobservable in rates and
    accelerations.
    """
    size = np.diag(normal)
    seen = size > 0
    seen[-states:] = size[-states:] > _UNSEEN * size[-states:].max()
    return np.where(seen, 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
