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

from sprung.model.diagnosis.fit.linear_equivalent import with_equivalents
from sprung.model.diagnosis.fit.memory import key_of
from sprung.model.diagnosis.fit.posterior import normal_equations, with_priors
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working, along_measured_motion, opened
from sprung.model.diagnosis.fit.steps import FitSearch, state_at, stepped, with_optimal_start
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Noise
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, warm_start_of
from sprung.model.diagnosis.response.motion import Motions
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray


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
    refused: bool = False  # whether the last step was, so that `left` is the fall promised to the optimum
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
    state = state_at(problem, *_begun(problem, start, whitener))
    if not problem.system.file.inputs:
        state = with_optimal_start(problem, state)
    search, count = FitSearch(state), 0
    for count in range(1, max(1, round(problem.rules.fit.patience * iterations)) + 1):
        search = stepped(problem, search, count, tolerance)
        if search.ended:
            break
    return _finish(problem, search, count)


def _begun(problem: Problem, start: Point, whitener: Whitener | None) -> tuple[Point, Working]:
    """The start with its laws' equivalents in the plant, and the weights of its residual."""
    if problem.process_noise:
        point, working = along_measured_motion(problem, start)
        return along_measured_motion(problem, with_equivalents(problem, point, working.inputs))
    return opened(problem, with_equivalents(problem, start, None), whitener)


def information(problem: Problem, fit: Fit) -> FloatArray:
    """Information matrix of theta, the terms' parameters (internal scale) and the state, priors included, (X, X)."""
    return with_priors(problem, fit.point, fit.jacobian.T @ fit.jacobian)


def _finish(problem: Problem, search: FitSearch, count: int) -> Fit:
    """The fit where a search ended, with its uncertainty."""
    state = search.state
    point, lin = state.point, state.lin
    P = len(point.theta)
    free = lin.jacobian.shape[1] - len(point.state)
    scaled, scale = normal_equations(problem, lin, point)
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
        left=search.left,
        iterations=count,
        unsettled=problem.rules.fit.unsettled,
        refused=search.failed,
        bounded=any(t.bounded for t in point.terms),
    )
