"""Smoothing of the inputs within their noise, with laws along the smoothed motion.

Beside the point, a step of the optimiser needs one value, `Working`: weights and smoothed inputs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.problem import Problem, SmoothedInputs
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.record.spectra import DEGREE, OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.harmonic_balance import HarmonicBalance, fixed_point
from sprung.model.diagnosis.response.point import Point
from sprung.model.signals import FloatArray

_FOLLOWED = 1e-4  # relative tolerance of the laws' forces along a smoothed motion
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding
_COSTLY = 2.0  # times a free run's, the cost of an evaluation that smooths the inputs as well
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


def smoothed(problem: Problem, point: Point, working: Working, whitened: ComplexArray) -> tuple[Point, Working]:
    """Smooth the inputs at a point whose whitened residual is about `whitened` (F, S).

    Returns the point and its weights; in systems with measured forces the initial state is fitted anew.
    """
    if problem.process_noise:
        return along_measured_motion(problem, point)
    shift = _shift(working.whitener, whitened, problem.part.support.shape[1])
    return point, replace(working, inputs=SmoothedInputs(_with_shift(problem.part, shift)))


def along_measured_motion(problem: Problem, point: Point) -> tuple[Point, Working]:
    """Smooth measured forces, with laws along the motion that results.

    A measured force stands for all other forces on the body, so its noise is large, and the smoothed motion is close
    to the measured one rather than a free run.  Laws' forces, state and smoothed inputs depend on each other and are
    found by fixed-point iteration.
    """
    forward = problem.forward(replace(point, warm_start=()))
    smoother = _Smoother.of(problem, forward)
    balance = forward.harmonic_balance(point.state)
    if balance is None:
        state, whitened = smoother.explained(smoother.base)
        inputs = SmoothedInputs(_with_shift(problem.part, smoother.shift(whitened)))
        return replace(point, state=state), Working(smoother.whitener, inputs, forward.plant)
    answer = _Answer.of(smoother, balance)
    start = (
        np.column_stack(point.warm_start)
        if point.warm_start
        else answer(np.zeros((len(balance.d0), len(balance.terms))))
    )
    force, settled = fixed_point(answer, start, _FOLLOWED)
    problem.count(_COSTLY * balance.evaluations)
    state, whitened = smoother.explained(answer.whitened(*problem.part.grid.split_law_forces(force)))
    inputs = SmoothedInputs(_with_shift(problem.part, smoother.shift(whitened)), force, settled)
    return replace(point, state=state, warm_start=tuple(force.T)), Working(smoother.whitener, inputs, forward.plant)


@dataclass(frozen=True)
class _Smoother:
    """The smoother of a model's inputs, and its initial state, by the whitened residual (F, S)."""

    problem: Problem
    forward: Forward
    whitener: Whitener  # of the present plant
    free: ComplexArray  # whitened free motion per state at the first sample, (F, S, 2n)
    of_residual: FloatArray  # state by the packed residual, (2n, 2 F S)
    base: ComplexArray  # whitened residual without laws and free motion

    @classmethod
    def of(cls, problem: Problem, forward: Forward) -> _Smoother:
        whitener, part = Whitener.of(forward, problem.noise), problem.part
        free = whitener.whitened(problem.free_columns(forward), part)
        columns = part.grid.pack(free)
        scale = scale_of(columns.T @ columns, columns.shape[1])
        of_residual = scale[:, None] * np.linalg.pinv(columns * scale, rcond=1e-9)
        base = whitener.whitened(part.sensors - problem.shown(forward, None), part)
        return cls(problem, forward, whitener, free, of_residual, base)

    def explained(self, whitened: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        """The initial state (2n,) that explains most of a whitened residual, and what it leaves, (F, S)."""
        state = self.of_residual @ self.problem.part.grid.pack(whitened)
        return state, whitened - self.free @ state

    def shift(self, whitened: ComplexArray) -> ComplexArray:
        """Change of the inputs by what is left, (F, supports + forces)."""
        return _shift(self.whitener, whitened, self.problem.part.support.shape[1])


@dataclass(frozen=True)
class _Answer:
    """Forces of laws (4N, m) along the motion that others make under inputs smoothed beside them.

    All but the laws is linear: the response to the measured inputs, to their shift and to the laws' forces.
    """

    smoother: _Smoother
    balance: HarmonicBalance
    of_spectrum: ComplexArray  # whitened sensor signals per transformed force, (F, S, m)
    of_line: ComplexArray  # the same per polynomial force, (F, S, 2, m)
    deflection: ComplexArray  # along the ports under the measured inputs, (F', m), periodic part
    polynomial: FloatArray  # the same, polynomial part, (DEGREE + 1, m)
    by_inputs: ComplexArray  # deflection per shift of the inputs, (F, m, supports + forces)
    by_steady: FloatArray  # the same per steady force, (DEGREE + 1, m, forces)
    rows: FloatArray  # deflections, then rates, per state, (2m, 2n)

    @classmethod
    def of(cls, smoother: _Smoother, balance: HarmonicBalance) -> _Answer:
        forward, plant, grid = smoother.forward, balance.plant, balance.grid
        band, factor, wide, s = grid.band, smoother.whitener.factor, balance.wide, plant.structure
        shown = plant.sensor_of_force[band] @ wide.T * forward.sensor_factor[band, :, None]
        sensors, none = len(s.sensor_kind), np.zeros_like(forward.part.sensors)
        still = np.zeros_like(forward.part.support_polynomial)
        resting = forward.shown(none, np.zeros((DEGREE + 1, sensors)))
        lines = np.empty((len(grid.omega), sensors, 2, len(balance.terms)), dtype=complex)
        for b, port in enumerate(wide):
            for k in range(2):
                line = np.zeros((DEGREE + 1, len(s.H)))
                line[k] = port
                seen = plant.polynomial_sensors(balance.lines[b, k], still, line)
                lines[:, :, k, b] = forward.shown(none, seen) - resting
        gains = np.concatenate([forward.support_gain, forward.force_faults[0]])
        load = np.zeros((DEGREE + 1, *s.F.shape))
        load[0] = s.F / forward.force_faults[0]
        steady = np.stack([plant.polynomial_response(load[..., i]) for i in range(s.F.shape[1])], axis=2)
        return cls(
            smoother,
            balance,
            factor @ shown / (OVERSAMPLING * np.sqrt(grid.samples)),
            (factor @ lines[band].reshape(len(factor), sensors, -1)).reshape(len(factor), sensors, 2, -1),
            forward.linear_deflection @ wide.T,
            forward.polynomial[1] @ wide.T,
            wide @ plant.deflection_of_inputs[band] / gains,
            np.einsum("pni,mn->pmi", steady, wide @ s.H),
            s.motion_rows(wide),
        )

    def whitened(self, spectrum: ComplexArray, line: FloatArray) -> ComplexArray:
        """Whitened residual beside forces, split into a transform and a polynomial, without free motion."""
        seen = (self.of_spectrum @ spectrum[: len(self.of_spectrum), :, None])[:, :, 0]
        return np.asarray(self.smoother.base - seen - np.einsum("fskb,kb->fs", self.of_line, line[:2]))

    def __call__(self, force: FloatArray) -> FloatArray:
        balance, grid, forward = self.balance, self.balance.grid, self.smoother.forward
        spectrum, line = grid.split_law_forces(force)
        state, left = self.smoother.explained(self.whitened(spectrum, line))
        shift = self.smoother.shift(left)
        supports = forward.part.support.shape[1]
        steady = np.real(shift[0, supports:]) / np.sqrt(grid.samples)
        shift[0, supports:] = 0.0
        deflection = self.deflection.copy()
        deflection[grid.band] += (self.by_inputs @ shift[:, :, None])[:, :, 0]
        polynomial = self.polynomial + self.by_steady @ steady
        driven = balance.under(forward.fine_motion_of(deflection, polynomial, self.rows, state))
        balance.evaluations += len(balance.terms)
        return driven.law_forces(*driven.motion_of(spectrum, line))


def _shift(whitener: Whitener, whitened: ComplexArray, supports: int) -> ComplexArray:
    """Change of the inputs by a whitened residual (F, S), (F, supports + forces)."""
    size = np.mean(np.abs(whitened) ** 2, axis=1)
    local = np.convolve(np.pad(size, _WIDTH // 2, mode="edge"), np.ones(_WIDTH) / _WIDTH, mode="valid")
    shift = (whitener.smoother_gain @ whitened[:, :, None])[:, :, 0]
    shift[:, :supports] /= np.maximum(1.0, local)[:, None]
    return np.asarray(shift)


def _with_shift(part: Part, shift: ComplexArray) -> Part:
    """The part with inputs shifted."""
    support, force, band = part.support.copy(), part.force.copy(), part.grid.band
    count = support.shape[1]
    support[band] += shift[:, :count]
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
