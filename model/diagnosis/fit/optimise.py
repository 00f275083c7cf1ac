"""Maximum likelihood estimation of parameters, terms and initial state on one part of a recording.

Minimising r^H R^-1 r (`problem`) over the parameters is the functional maximum likelihood of an errors-in-variables
model, the true inputs being profiled out: u = u_m + S_u G^H R^-1 r.  Gauss-Newton with the sensitivities taken at that
smoothed input is free of the attenuation bias that noisy regressors cause (Soderstrom 2007).

The "noise" of a measured force, in contrast, acts on the body: it comprises unmeasured forces.  The likelihood is then
that of a system with process noise, r^H R^-1 r + log det R (Astrom 1980), and laws act along the measured motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.fit.jacobian import Linearised, linearise
from sprung.model.diagnosis.fit.linear_equivalent import with_equivalents
from sprung.model.diagnosis.fit.memory import key_of
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working, along_measured_motion, opened, scale_of, smoothed
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Noise
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, warm_start_of
from sprung.model.diagnosis.response.motion import Motions
from sprung.model.diagnosis.response.point import Point, advance, at_active_bounds
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

_DAMPING = (1e-6, 1e3)  # first and most, of the scaled normal equations
_MUCH = 0.03  # of chi-square, that a step promises: if it fails, initial state and reaction of the laws are refined
_STARTS, _LOWER = 5, 0.01  # of these, at most, while each lowers the objective by this share
_FAST, _PARALLEL = 0.3, 0.9  # ratio of steps that converge soon enough; cosine of steps whose ratio counts
_RELAXED = (0.3, 2.0)  # least and most of a step that is taken
_HOPEFUL = 0.5  # of the fall that is needed, that it has to promise; where it succeeded, it promised 0.96 and more


@dataclass(frozen=True)
class Fit:
    """A maximum-likelihood fit."""

    point: Point
    chi_square: float  # r^T r
    log_det: float  # of the residual's covariance
    log_det_slope: FloatArray  # by theta and term parameters (internal scale), (P + p,)
    noise: Noise
    whitener: Whitener  # of the residual
    count: int  # real residuals
    covariance: FloatArray  # of theta and the term parameters, (P + p, P + p)
    residual: FloatArray  # whitened, (R,)
    jacobian: FloatArray  # (R, P + p + 2n)
    spectrum: ComplexArray  # unwhitened residual, (F, S)
    forward: Forward
    forces: LawForces | None
    motions: Motions
    left: float  # decrease of the objective in the last step, or predicted for a rejected one
    iterations: int
    unsettled: float  # of its last decrease, beyond which a fit has not converged
    bounded: bool = False  # whether a law's parameter is at a bound

    def place(self, index: int) -> slice:
        """Position of a term's parameters in the covariance."""
        counts = [len(term.parameters) for term in self.point.terms]
        first = len(self.point.theta) + sum(counts[:index])
        return slice(first, first + counts[index])

    @property
    def converged(self) -> bool:
        """Whether the last decrease of the objective is too small to matter, and laws agree with a smoothed motion."""
        agree = self.forces is None or self.forces.converged or not self.noise.process_noise
        return agree and self.left < self.unsettled * self.grain

    @property
    def grain(self) -> float:
        """Decrease of the objective equivalent to one unit of evidence, which counts ratios above the noise."""
        return 1.0 if self.noise.process_noise else max(1.0, self.reduced)

    @property
    def deviance(self) -> float:
        """Twice the negative log-likelihood, up to a constant."""
        return self.chi_square + self.log_det

    @cached_property
    def element_motion(self) -> tuple[FloatArray, FloatArray]:
        """Deflection and rate of every element, oversampled, 2 x (4N, E)."""
        forward, forces = self.forward, self.forces
        d, v = forward.fine_motion(np.eye(forward.elements), self.point.state)
        if forces is not None:
            grid, plant = forward.part.grid, forward.plant
            spectrum = forces.deflections[:, : forward.elements]
            polynomial = forces.motion @ plant.structure.H[: forward.elements].T
            d = d + grid.fine(spectrum) + grid.fine_monomials @ polynomial
            rate = grid.fine(1j * grid.omega[:, None] * spectrum)
            v = v + rate + grid.fine_monomials @ plant.derivative(polynomial)
        return d, v

    def force_along(self, term: Term) -> FloatArray:
        """Force of a law along this fit's motion, (4N,)."""
        grid, port = self.forward.part.grid, term.port(self.forward.system)
        d, v = (motion @ port for motion in self.element_motion)
        time = grid.start + grid.fine_time
        element = self.forward.element_of(term)
        return force_along(term.element_law, term.parameters, d, v, time, element)

    @property
    def reduced(self) -> float:
        """Chi-square per degree of freedom."""
        found: float = self.chi_square / max(1, self.count - self.jacobian.shape[1])
        return found


@dataclass(frozen=True)
class _State:
    """State of the optimiser."""

    point: Point
    working: Working
    lin: Linearised
    value: float  # of the objective

    @property
    def chi_square(self) -> float:
        return float(self.lin.residual @ self.lin.residual)


def try_optimise(problem: Problem, start: Point, iterations: int, whitener: Whitener | None = None) -> Fit | None:
    """As `optimise`; None if the fit diverges or the budget of work is exhausted."""
    if problem.worked_out:
        return None
    try:
        with np.errstate(all="ignore"):  # what diverges is judged by its chi-square
            fit = optimise(problem, start, iterations=iterations, whitener=whitener)
    except (np.linalg.LinAlgError, FloatingPointError):
        return None
    return fit if np.isfinite(fit.chi_square) else None


def falling(problem: Problem, fit: Fit, iterations: int, rounds: int) -> Fit:
    """A fit that goes on with the same weights, in rounds of `iterations`, until it converges or falls no more."""
    for _ in range(rounds):
        if fit.converged:
            break
        on = try_optimise(problem, fit.point, iterations, fit.whitener)
        if on is None or on.chi_square >= fit.chi_square:
            break
        fit = on
    return fit


def optimise(
    problem: Problem,
    start: Point,
    iterations: int = 12,
    tolerance: float = 1e-3,
    whitener: Whitener | None = None,
) -> Fit:
    """Gauss-Newton with Levenberg-Marquardt damping; stops when no parameter moves by `tolerance` std.

    Steps that raise the objective are rejected.  As every step smooths the inputs anew, by the residual that it
    promises, a small rise may be theirs: the present point is then linearised under the same new inputs.
    `whitener`: of the fit whose chi-square this one is compared with; by default of the model at the start.
    """
    if problem.memory is None:
        return _optimised(problem, start, iterations, tolerance, whitener)
    others = (
        iterations,
        tolerance,
        problem.newton_allowed,
        problem.rules.fit,
        None if whitener is None else whitener.factor,
    )
    key = key_of(problem.system, problem.part, problem.noise, start, *others)
    known: Fit = problem.memory.recall(key, lambda: _optimised(problem, start, iterations, tolerance, whitener))
    return known


def _optimised(problem: Problem, start: Point, iterations: int, tolerance: float, whitener: Whitener | None) -> Fit:
    state = _state(problem, *_begun(problem, start, whitener))
    if not problem.system.file.inputs:
        state = _begun_anew(problem, state)
    search, count = _Search(state), 0
    for count in range(1, max(1, round(problem.rules.fit.patience * iterations)) + 1):
        search = _stepped(problem, search, count, tolerance)
        if search.ended:
            break
    return _finish(problem, search.state, search.left, count)


def _stepped(problem: Problem, search: _Search, count: int, tolerance: float) -> _Search:
    """The search after its `count`-th step, which is accepted, refused, or taken again from the present point."""
    rules, state = problem.rules.fit, search.state
    step, sigma, promised = _step(problem, state.lin, state.point, search.damping)
    if not problem.process_noise:  # whose sensitivities know what the smoother makes of the laws' forces
        search = replace(search, relaxation=search.relaxation.after(state.lin.jacobian @ step))
    step = search.relaxation.factor * step
    size = float(np.max(np.abs(step[: len(sigma)]) / np.maximum(sigma, 1e-300))) if len(sigma) else 0.0
    grain = _grain(problem, state)
    proposed = _proposed(problem, state, step, promised)
    if proposed.value >= state.value and promised < rules.numerical * grain:
        return replace(search, left=promised, ended=True)
    rise = proposed.value - state.value
    if 0 <= rise < rules.smoothing * state.chi_square and not (search.renewed or problem.process_noise):
        search = search.renewed_by(_state(problem, state.point, proposed.working, fine=state.lin.fine))
        if proposed.value >= search.state.value:
            return replace(search, left=promised, relaxation=_Relaxation())
    if proposed.value < search.state.value:
        search = search.accepted(proposed)
        if size < tolerance or search.left < rules.done * grain * max(1.0, size):
            return replace(search, ended=True)
        return search.with_equivalents(problem) if count in (2, 4) else search
    if promised > _MUCH * search.state.chi_square and search.state.lin.may_be_finer:
        return search.finer(promised)
    return search.refused(promised)


def _proposed(problem: Problem, state: _State, step: FloatArray, promised: float) -> _State:
    """The model a step further, under inputs smoothed by the residual that the step is to leave."""
    trial, working = smoothed(problem, advance(state.point, step), state.working, state.lin.whitened_after(step))
    proposed = _state(problem, trial, working, fine=state.lin.fine)
    if not problem.system.file.inputs:
        return _begun_anew(problem, proposed)
    if not problem.process_noise and promised > _MUCH * state.chi_square:
        return _lower_by_its_start(problem, proposed, state.value)
    return proposed


@dataclass(frozen=True)
class _Relaxation:
    """Share of a step that is taken, by Aitken's method for vector sequences (Irons and Tuck 1969).

    The covariance R and the smoother know the plant with equivalents of its laws, not the laws: where a law adds to the
    stiffness, steps of Gauss-Newton overshoot by a constant ratio and come back, or fall short by one.
    """

    factor: float = 1.0
    last: FloatArray | None = None  # full step before, by what it was to change of the whitened residual, (R,)

    def after(self, change: FloatArray) -> _Relaxation:
        """That of the next full step: the ratio of steps that are parallel says how far they go beside the mark."""
        if self.last is None:
            return replace(self, last=change)
        along, size = float(change @ self.last), float(self.last @ self.last)
        ratio = along / max(size, 1e-300)
        if abs(ratio) < _FAST:
            return replace(self, last=change)
        if abs(along) < _PARALLEL * np.sqrt(size * float(change @ change)) or ratio >= 1:
            return _Relaxation(1.0, change)
        return _Relaxation(float(np.clip(self.factor / (1 - ratio), *_RELAXED)), change)


@dataclass(frozen=True)
class _Search:
    """Where the optimiser is, and how its last step went."""

    state: _State
    damping: float = _DAMPING[0]
    left: float = np.inf  # by which the objective fell last, or what a step that was not taken promised
    relaxation: _Relaxation = _Relaxation()
    renewed: bool = False  # whether the present point's inputs were smoothed anew
    ended: bool = False

    def renewed_by(self, state: _State) -> _Search:
        """At the same point, under inputs smoothed anew."""
        return replace(self, state=state, renewed=True)

    def accepted(self, proposed: _State) -> _Search:
        """A step further, with less damping."""
        left, damping = self.state.value - proposed.value, max(self.damping / 10, _DAMPING[0] / 1e3)
        return replace(self, state=proposed, renewed=False, left=left, damping=damping)

    def with_equivalents(self, problem: Problem) -> _Search:
        """With the laws' linear equivalents at the present values."""
        point = with_equivalents(problem, self.state.point, self.state.working.inputs)
        return replace(self, state=replace(self.state, point=point))

    def finer(self, promised: float) -> _Search:
        """With finer sensitivities: those of before promise what does not come."""
        return replace(self, left=promised, state=replace(self.state, lin=replace(self.state.lin, fine=True)))

    def refused(self, promised: float) -> _Search:
        """At the same point with more damping; ended where there is no more."""
        damping = max(self.damping * 30, 100 * _DAMPING[0])
        ended = damping > _DAMPING[1]
        return replace(self, left=promised, relaxation=_Relaxation(), damping=damping, ended=ended)


def _grain(problem: Problem, state: _State) -> float:
    """Decrease of the objective that matters: a share of it where the misfit exceeds noise."""
    rows, columns = state.lin.jacobian.shape
    return 1.0 if problem.process_noise else max(1.0, state.chi_square / max(1, rows - columns))


def _begun(problem: Problem, start: Point, whitener: Whitener | None) -> tuple[Point, Working]:
    """The start with its laws' equivalents in the plant, and the weights of its residual."""
    if problem.process_noise:
        point, working = along_measured_motion(problem, start)
        return along_measured_motion(problem, with_equivalents(problem, point, working.inputs))
    return opened(problem, with_equivalents(problem, start, None), whitener)


def _state(problem: Problem, point: Point, working: Working, *, fine: bool = False) -> _State:
    """The model linearised at a point.  Objective: twice the negative log-posterior, up to a constant."""
    lin = linearise(problem, point, working, fine=fine)
    value = _value(problem, lin.residual, lin.log_det, point)
    return _State(replace(point, warm_start=warm_start_of(lin.forces)), working, lin, value)


def _begun_anew(problem: Problem, state: _State, below: float = np.inf) -> _State:
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
    other = _state(problem, replace(state.point, state=state.point.state + step), state.working, fine=state.lin.fine)
    return other if other.value < state.value else state


def _lower_by_its_start(problem: Problem, proposed: _State, below: float) -> _State:
    """A proposal above the present value, with its initial state estimated anew until it is below.

    Sensitivities hold beside a free motion: the motion that laws answer with is periodic in them, and not in the model.
    Laws that dominate a slowly decaying motion turn steps in the right direction uphill for this reason alone.
    """
    for _ in range(_STARTS):
        forces = proposed.lin.forces
        if proposed.value < below or forces is None or not forces.converged:
            break
        before, proposed = proposed, _begun_anew(problem, proposed, below)
        if proposed.value > before.value - _LOWER * abs(before.value):
            break
    return proposed


def _value(problem: Problem, residual: FloatArray, log_det: float, point: Point) -> float:
    return float(residual @ residual + log_det + np.sum(_prior_residual(problem, point)[0] ** 2))


def _prior_residual(problem: Problem, point: Point) -> tuple[FloatArray, FloatArray]:
    """Prior residuals of theta and the terms' parameters, in standard deviations, and their weights, each (P + p,)."""
    prior = problem.rules.fit.prior
    away, sharp = [point.theta / prior], [np.full(len(point.theta), 1 / prior)]
    for term in point.terms:
        away.append(term.prior_deviations)
        sharp.append(1 / np.array(term.known) if term.known else np.zeros(len(term.parameters)))
    return np.concatenate(away), np.concatenate(sharp)


def information(problem: Problem, fit: Fit) -> FloatArray:
    """Information matrix of theta, the terms' parameters (internal scale) and the state, priors included, (X, X)."""
    return _with_expected(problem, fit.point, fit.jacobian.T @ fit.jacobian)


def _with_expected(problem: Problem, point: Point, gram: FloatArray) -> FloatArray:
    sharp = _prior_residual(problem, point)[1]
    normal = gram.copy()
    normal[np.arange(len(sharp)), np.arange(len(sharp))] += sharp**2
    return normal


def _normal(problem: Problem, lin: Linearised, point: Point) -> tuple[FloatArray, FloatArray]:
    """Scaled matrix of the normal equations, priors included, and the scales."""
    normal = _with_expected(problem, point, lin.gram)
    scale = scale_of(normal, len(point.state))
    return normal * scale * scale[:, None], scale


def _step(problem: Problem, lin: Linearised, point: Point, damping: float) -> tuple[FloatArray, FloatArray, float]:
    """Gauss-Newton step, standard deviations of theta and term parameters, and the predicted decrease."""
    scaled, scale = _normal(problem, lin, point)
    gradient = lin.jacobian.T @ lin.residual
    gradient[: len(lin.log_det_slope)] -= lin.log_det_slope / 2
    away, sharp = _prior_residual(problem, point)
    gradient[: len(sharp)] -= away * sharp
    step, variance, promised = _solved(scaled, scale, gradient, damping)
    held = at_active_bounds(point, step)
    if held.any():  # the step of the others at constant held values
        scaled[held], scaled[:, held], gradient[held] = 0.0, 0.0, 0.0
        step, variance, promised = _solved(scaled, scale, gradient, damping)
    free = len(scaled) - len(point.state)
    return step, np.sqrt(np.maximum(variance, 1e-300))[:free], promised


def _solved(
    scaled: FloatArray, scale: FloatArray, gradient: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray, float]:
    """Solution of the damped normal equations, its variances, and the predicted decrease with least damping."""
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, 0.0)
    turned = vectors.T @ (gradient * scale)
    damped = values + damping + 1e-13
    step = scale * (vectors @ (turned / damped))
    return step, scale**2 * (vectors**2 @ (1 / damped)), float(np.sum(turned**2 / (values + _DAMPING[0])))


def _finish(problem: Problem, state: _State, left: float, count: int) -> Fit:
    """The fit at a state, with its uncertainty."""
    point, lin = state.point, state.lin
    P = len(point.theta)
    free = lin.jacobian.shape[1] - len(point.state)
    scaled, scale = _normal(problem, lin, point)
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    covariance = (inverse * scale * scale[:, None])[:free, :free]
    slopes = np.concatenate([np.ones(P), *[t.slopes for t in point.terms]]) if point.terms else np.ones(P)
    covariance = covariance * slopes * slopes[:, None]
    return Fit(
        point=replace(point, warm_start=warm_start_of(lin.forces)),
        chi_square=float(lin.residual @ lin.residual),
        log_det=lin.log_det,
        log_det_slope=lin.log_det_slope,
        noise=problem.noise,
        whitener=state.working.whitener,
        count=len(lin.residual),
        covariance=covariance,
        residual=lin.residual,
        jacobian=lin.jacobian,
        spectrum=lin.spectrum,
        forward=lin.forward,
        forces=lin.forces,
        motions=lin.motions,
        left=left,
        iterations=count,
        unsettled=problem.rules.fit.unsettled,
        bounded=any(t.bounded for t in point.terms),
    )
