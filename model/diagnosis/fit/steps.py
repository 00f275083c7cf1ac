"""Steps of a fit: Gauss-Newton with Levenberg-Marquardt damping, accepted, refused, relaxed or taken again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.jacobian import Linearised, linearise
from sprung.model.diagnosis.fit.linear_equivalent import with_equivalents
from sprung.model.diagnosis.fit.posterior import LEAST_DAMPING, gauss_newton_step, objective
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working, smoothed
from sprung.model.diagnosis.response.harmonic_balance import warm_start_of
from sprung.model.diagnosis.response.point import Point, advance
from sprung.model.signals import FloatArray

_MOST_DAMPING = 1e3  # of the scaled normal equations
_MUCH = 0.03  # of chi-square, that a step promises: if it fails, initial state and reaction of the laws are refined
_STARTS, _LOWER = 5, 0.01  # of these, at most, while each lowers the objective by this share
_FAST, _PARALLEL = 0.3, 0.9  # ratio of steps that converge soon enough; cosine of steps whose ratio counts
_RELAXED = (0.3, 2.0)  # least and most of a step that is taken
_EQUIVALENTS = (2, 4)  # accepted steps after which the laws' linear equivalents are renewed
_HOPEFUL = 0.5  # of the fall that is needed, that it has to promise; where it succeeded, it promised 0.96 and more


@dataclass(frozen=True)
class SearchState:
    """State of the optimiser."""

    point: Point
    working: Working
    lin: Linearised
    value: float  # of the objective

    @property
    def chi_square(self) -> float:
        return float(self.lin.residual @ self.lin.residual)


@dataclass(frozen=True)
class StepRelaxation:
    """Share of a step that is taken, by Aitken's method for vector sequences (Irons and Tuck 1969).

    The covariance R and the smoother know the plant with equivalents of its laws, not the laws: where a law adds to the
    stiffness, steps of Gauss-Newton overshoot by a constant ratio and come back, or fall short by one.
    """

    factor: float = 1.0
    last: FloatArray | None = None  # full step before, by what it was to change of the whitened residual, (R,)

    def after(self, change: FloatArray) -> StepRelaxation:
        """That of the next full step: the ratio of steps that are parallel says how far they go beside the mark."""
        if self.last is None:
            return replace(self, last=change)
        along, size = float(change @ self.last), float(self.last @ self.last)
        ratio = along / max(size, 1e-300)
        if abs(ratio) < _FAST:
            return replace(self, last=change)
        if abs(along) < _PARALLEL * np.sqrt(size * float(change @ change)) or ratio >= 1:
            return StepRelaxation(1.0, change)
        return StepRelaxation(float(np.clip(self.factor / (1 - ratio), *_RELAXED)), change)


@dataclass(frozen=True)
class FitSearch:
    """Where the optimiser is, and how its last step went."""

    state: SearchState
    damping: float = LEAST_DAMPING
    left: float = np.inf  # by which the objective fell last, or what a step that was not taken promised
    relaxation: StepRelaxation = StepRelaxation()
    renewed: float | None = None  # by how much the objective moved as the present point's inputs were smoothed anew
    failed: bool = False  # whether a step from the present point was refused
    ended: bool = False

    def renewed_by(self, state: SearchState) -> FitSearch:
        """At the same point, under inputs smoothed anew."""
        return replace(self, state=state, renewed=abs(state.value - self.state.value))

    def accepted(self, proposed: SearchState) -> FitSearch:
        """A step further, with less damping."""
        left, damping = self.state.value - proposed.value, max(self.damping / 10, LEAST_DAMPING / 1e3)
        return replace(self, state=proposed, renewed=None, failed=False, left=left, damping=damping)

    def with_equivalents(self, problem: Problem) -> FitSearch:
        """With the laws' linear equivalents at the present values."""
        point = with_equivalents(problem, self.state.point, self.state.working.inputs)
        return replace(self, state=replace(self.state, point=point))

    def finer(self, promised: float) -> FitSearch:
        """With finer sensitivities: those of before promise what does not come."""
        return replace(self, left=promised, state=replace(self.state, lin=replace(self.state.lin, fine=True)))

    def refused(self, promised: float) -> FitSearch:
        """At the same point with more damping; ended where there is no more."""
        damping = max(self.damping * 30, 100 * LEAST_DAMPING)
        ended = damping > _MOST_DAMPING
        return replace(self, left=promised, relaxation=StepRelaxation(), damping=damping, failed=True, ended=ended)


@dataclass(frozen=True)
class ProposedStep:
    """What a step promised, and how far it went."""

    promised: float  # decrease of the objective by its linear model
    grain: float  # decrease of the objective that matters
    size: float  # largest change, in standard deviations
    short: bool  # whether no value changes by more than the tolerance


def stepped(problem: Problem, search: FitSearch, count: int, tolerance: float) -> FitSearch:
    """The search after its `count`-th step, which is accepted, refused, or taken again from the present point."""
    rules, state = problem.rules.fit, search.state
    step, sigma, promised, promised_damped = gauss_newton_step(problem, state.lin, state.point, search.damping)
    grain = _grain(problem, state)
    if search.failed and promised_damped < rules.numerical * grain:  # longer ones do not keep what they promise
        return replace(search, left=promised if promised > rules.told * grain else promised_damped, ended=True)
    if not problem.process_noise:  # whose sensitivities know what the smoother makes of the laws' forces
        search = replace(search, relaxation=search.relaxation.after(state.lin.jacobian @ step))
    step = search.relaxation.factor * step
    size = float(np.max(np.abs(step[: len(sigma)]) / np.maximum(sigma, 1e-300))) if len(sigma) else 0.0
    taken = ProposedStep(promised, grain, size, short=size < tolerance)
    proposed = _proposed(problem, state, step, promised)
    if proposed.value >= state.value and promised < rules.numerical * grain:
        return replace(search, left=promised, ended=True)
    rise = proposed.value - state.value
    if 0 <= rise < rules.smoothing * state.chi_square and search.renewed is None and not problem.process_noise:
        search = search.renewed_by(state_at(problem, state.point, proposed.working, fine=state.lin.fine))
        if proposed.value >= search.state.value:
            return replace(search, left=promised, relaxation=StepRelaxation())
    if proposed.value < search.state.value:
        return _accepted(problem, search.accepted(proposed), taken, count)
    return _refused(problem, search, taken)


def _accepted(problem: Problem, search: FitSearch, step: ProposedStep, count: int) -> FitSearch:
    """The search after a step that lowered the objective; ended where what is left is too little to matter."""
    if step.short:  # what it fell besides, by inputs smoothed anew, is not left
        return replace(search, left=min(search.left, step.promised), ended=True)
    if search.left < problem.rules.fit.done * step.grain * max(1.0, step.size):
        return replace(search, ended=True)
    return search.with_equivalents(problem) if count in _EQUIVALENTS else search


def _refused(problem: Problem, search: FitSearch, step: ProposedStep) -> FitSearch:
    """The search after a step that did not: with finer sensitivities or more damping, or ended."""
    if search.renewed is not None and step.promised < min(search.renewed, problem.rules.fit.told * step.grain):
        return replace(search, left=0.0, ended=True)  # nothing that smoothing the inputs does not move as much
    if step.promised > _MUCH * search.state.chi_square and search.state.lin.may_be_finer:
        return search.finer(step.promised)
    refused = search.refused(step.promised)
    return replace(refused, ended=True) if step.short else refused


def _proposed(problem: Problem, state: SearchState, step: FloatArray, promised: float) -> SearchState:
    """The model a step further, under inputs smoothed by the residual that the step is to leave."""
    trial, working = smoothed(problem, advance(state.point, step), state.working, state.lin.whitened_after(step))
    proposed = state_at(problem, trial, working, fine=state.lin.fine)
    if not problem.system.file.inputs:
        return with_optimal_start(problem, proposed)
    if not problem.process_noise and promised > _MUCH * state.chi_square:
        return _lower_by_its_start(problem, proposed, state.value)
    return proposed


def state_at(problem: Problem, point: Point, working: Working, *, fine: bool = False) -> SearchState:
    """The model linearised at a point.  Objective: twice the negative log-posterior, up to a constant."""
    lin = linearise(problem, point, working, fine=fine)
    value = objective(problem, lin.residual, lin.log_det, point)
    return SearchState(replace(point, warm_start=warm_start_of(lin.forces)), working, lin, value)


def with_optimal_start(problem: Problem, state: SearchState, below: float = np.inf) -> SearchState:
    """A free decay with the optimal initial state for its parameters (variable projection, Golub and Pereyra 1973).

    Joint steps converge slowly, since parameters act on the motion of the previous initial state; from rest, where
    they have no effect, they would converge to the prior.  below: nothing is tried that promises far less.
    """
    columns, residual = state.lin.jacobian[:, -len(state.point.state) :], state.lin.residual
    if not (np.isfinite(columns).all() and np.isfinite(residual).all()):
        return state  # diverged: judged by its value
    step = np.linalg.lstsq(columns, residual, rcond=None)[0]
    if float(np.sum((columns @ step) ** 2)) < _HOPEFUL * (state.value - below):
        return state
    other = state_at(problem, replace(state.point, state=state.point.state + step), state.working, fine=state.lin.fine)
    return other if other.value < state.value else state


def _lower_by_its_start(problem: Problem, proposed: SearchState, below: float) -> SearchState:
    """A proposal above the present value, with its initial state estimated anew until it is below.

    Sensitivities hold beside a free motion: the motion that laws answer with is periodic in them, and not in the model.
    Laws that dominate a slowly decaying motion turn steps in the right direction uphill for this reason alone.
    """
    for _ in range(_STARTS):
        forces = proposed.lin.forces
        if proposed.value < below or forces is None or not forces.converged:
            break
        before, proposed = proposed, with_optimal_start(problem, proposed, below)
        if proposed.value > before.value - _LOWER * abs(before.value):
            break
    return proposed


def _grain(problem: Problem, state: SearchState) -> float:
    """Decrease of the objective that matters: a share of it where the misfit exceeds noise."""
    rows, columns = state.lin.jacobian.shape
    return 1.0 if problem.process_noise else max(1.0, state.chi_square / max(1, rows - columns))
