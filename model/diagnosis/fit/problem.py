"""Maximum likelihood of parameters, terms and starting state on one part of a recording.

Residual of bin w:   r = y - Y(theta, terms, x0; u),   covariance  R = diag(s^2) + G S_u G^H,

with G from the measured inputs to the sensors and S_u the inputs' noise.  Minimising r^H R^-1 r over the parameters
is the functional maximum likelihood of an errors-in-variables model, the true inputs being profiled out:
u = u_m + S_u G^H R^-1 r.  Gauss-Newton with the sensitivities taken at that smoothed input is free of the
attenuation bias that noisy regressors cause (Soderstrom 2007).

A measured force is another matter: between it and the body lies what nobody measured, so its "noise" really pushes
the body.  Then the likelihood is that of a system with process noise, r^H R^-1 r + log det R (Astrom 1980), and laws
act along the motion that the sensors saw.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.fit.columns import loads_of
from sprung.model.diagnosis.fit.jacobian import Linearisation, linearise
from sprung.model.diagnosis.fit.linear_equivalent import preloaded
from sprung.model.diagnosis.fit.smoothing import Smoothed, scale_of, smooth
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Noise, Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, near_of
from sprung.model.diagnosis.response.motion import Motions
from sprung.model.diagnosis.response.point import Point, advance, held_back
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray
from sprung.model.system import System

PRIOR = 1.0  # standard deviation of a log-ratio to nominal: keeps what nothing tells near its nominal value
_SLACK = 5e-4  # of the objective: inputs are smoothed again and loops solved again in every round


@dataclass(frozen=True)
class Fit:
    """A maximum-likelihood fit."""

    point: Point
    chi_square: float  # r^T r
    log_det: float  # of the residual's covariance
    log_det_slope: FloatArray  # by theta and term parameters (internal scale), (P + p,)
    noise: Noise
    count: int  # real residuals
    covariance: FloatArray  # of theta and the term parameters, (P + p, P + p)
    residual: FloatArray  # whitened, (R,)
    jacobian: FloatArray  # (R, P + p + 2n)
    spectrum: ComplexArray  # unwhitened residual, (F, S)
    forward: Forward
    forces: LawForces | None
    motions: Motions
    converged: bool
    iterations: int
    bounded: bool = False  # a law's parameter stopped at its bound

    def place(self, index: int) -> slice:
        """Where the parameters of a term stand in the covariance."""
        counts = [len(term.parameters) for term in self.point.terms]
        first = len(self.point.theta) + sum(counts[:index])
        return slice(first, first + counts[index])

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
            powers = np.vander(grid.fine_time / grid.length, len(polynomial), increasing=True)
            d = d + grid.fine(spectrum) + powers @ polynomial
            v = v + grid.fine(1j * grid.omega[:, None] * spectrum) + powers @ plant.derivative(polynomial)
        return d, v

    def force_along(self, term: Term) -> FloatArray:
        """Force of a law along this fit's motion, (4N,)."""
        grid, port = self.forward.part.grid, term.port(self.forward.system)
        d, v = (motion @ port for motion in self.element_motion)
        time = grid.start + grid.fine_time
        element = self.forward.element_of(term)
        return force_along(term.law, term.parameters, d, v, time, element)  # type: ignore[arg-type]

    @property
    def reduced(self) -> float:
        return self.chi_square / max(1, self.count - self.jacobian.shape[1])


@dataclass
class Problem:
    """One part of a recording with its noise, ready to be fitted."""

    system: System
    part: Part
    sensors: np.ndarray  # indices of the present sensors
    noise: Noise
    whitener: Whitener | None = None
    smoothed: Smoothed | None = None

    @property
    def follows(self) -> bool:
        """Whether laws act along the motion that the sensors saw: a measured force may lack what nobody measured."""
        return self.noise.follows

    def forward(self, point: Point) -> Forward:
        part = self.smoothed.part if self.smoothed else self.part
        return Forward(self.system, part, self.sensors, point.theta, point.terms, point.near)

    def predict(self, point: Point) -> tuple[ComplexArray, Forward, LawForces | None]:
        """Shown sensor signals, (F, S)."""
        forward = self.forward(point)
        forces = self.law_forces(forward, point)
        return self.shown(forward, forces), forward, forces

    def law_forces(self, forward: Forward, point: Point) -> LawForces | None:
        """Forces of the laws: along the smoothed motion where there is one, else of a free run."""
        if self.smoothed is None or self.smoothed.force is None:
            return forward.law_forces(point.state)
        loop = forward.loop(point.state)
        assert loop is not None
        return loop.answer(self.smoothed.force)

    def shown(self, forward: Forward, forces: LawForces | None) -> ComplexArray:
        """What the sensors show of a solution, (F, S)."""
        plant, part = forward.plant, forward.part
        periodic = forward.linear_sensors
        polynomial = plant.polynomial_sensors(forward.polynomial[0], forward.support_polynomial)
        if part is not self.part:
            periodic = periodic + self._of_input_noise(forward)
        if forces is not None:
            periodic = periodic + forces.sensors
            polynomial = polynomial + plant.polynomial_sensors(forces.motion, np.zeros_like(part.support_polynomial))
        shown = forward.shown(periodic, polynomial)
        for term in forward.terms:
            shown = shown + loads_of(forward, term)
        return shown

    def _of_input_noise(self, forward: Forward) -> ComplexArray:
        """What the linear plant makes of the measured inputs less the smoothed ones, (F, S)."""
        part, smoothed = self.part, forward.part
        forces = part.force - smoothed.force
        forces[0] += (part.force_polynomial - smoothed.force_polynomial)[0] * np.sqrt(part.grid.samples)
        return forward.plant.sensors(part.support - smoothed.support, forces / forward.force_faults[0])

    def linearise(self, point: Point) -> Linearisation:
        """Residual and sensitivities at a point."""
        return linearise(self, point)

    def smooth(self, point: Point, last: Linearisation | None = None) -> Point:
        """Smooth the inputs at a point near the last one; returns the point with its starting state to match."""
        return smooth(self, point, last)

    def free_columns(self, forward: Forward) -> ComplexArray:
        """Transforms of the free motion per state at the first sample, (F, S, 2n).

        In modal coordinates sum_k c l^k z^-k = c (1 - l^N) / (1 - l / z); by transform where the modes are too
        close to each other for that.
        """
        plant, grid = forward.plant, self.part.grid
        values, vectors = np.linalg.eig(plant.structure.state_matrix())
        if np.linalg.cond(vectors) > 1e9:
            return grid.forward(forward.free_rows())
        step = np.exp(values * grid.step)
        turn = np.exp(-1j * grid.omega * grid.step)
        last = np.exp(values * grid.length)
        near = np.abs(1 - turn[:, None] * step) < 1e-9  # an undamped mode on a bin
        scalar = np.where(near, grid.samples, (1 - last) / np.where(near, 1.0, 1 - turn[:, None] * step))
        rows = forward.free_rows_at_start() @ vectors
        modal = rows[None] * (scalar / np.sqrt(grid.samples))[:, None, :]
        return modal @ np.linalg.inv(vectors)

    def shown_by_motion(self, fit: Fit) -> ComplexArray:
        """What the sensors show of a fit's smoothed motion, (F, S)."""
        shown = self.part.sensors - fit.spectrum
        if fit.forward.part is self.part:
            return shown
        return shown - self._of_input_noise(fit.forward) * fit.forward.sensor_factor

    def try_fit(self, start: Point, iterations: int) -> Fit | None:
        """A fit that may go astray: None where the numbers do."""
        try:
            with np.errstate(all="ignore"):  # what diverges is judged by its chi-square
                fit = self.fit(start, iterations=iterations)
        except (np.linalg.LinAlgError, FloatingPointError, ValueError):
            return None
        return fit if np.isfinite(fit.chi_square) else None

    def fit(self, start: Point, iterations: int = 12, tolerance: float = 1e-3) -> Fit:
        """Gauss-Newton with Levenberg damping from `start`; stops when no parameter moves by `tolerance` std."""
        point = self.smooth(preloaded(self, self.smooth(start)))
        lin = self.linearise(point)
        best, kept = _objective(lin, point), (self.whitener, self.smoothed)
        damping, converged, count = 1e-6, False, 0
        for count in range(1, iterations + 1):
            step, sigma = _step(lin, point, damping)
            trial = self.smooth(advance(point, step), lin)
            size = float(np.max(np.abs(step[: len(sigma)]) / np.maximum(sigma, 1e-300))) if len(sigma) else 0.0
            proposal = self.linearise(trial)
            value = _objective(proposal, trial)
            if value <= best + _SLACK * float(lin.residual @ lin.residual) + 0.5:
                gained = best - value
                point, lin, best = replace(trial, near=near_of(proposal.forces)), proposal, value
                kept = self.whitener, self.smoothed
                damping = max(damping / 10, 1e-9)
                if size < tolerance or gained < 0.02 * max(1.0, size):
                    converged = True
                    break
                if count in (2, 4):
                    point = preloaded(self, point)
            else:
                damping = max(damping * 30, 1e-4)
                if damping > 1e3:
                    break
        self.whitener, self.smoothed = kept
        return _finish(self, point, lin, converged, count)


def _objective(lin: Linearisation, point: Point) -> float:
    return float(lin.residual @ lin.residual + lin.log_det + np.sum((point.theta / PRIOR) ** 2))


def _normal(lin: Linearisation, point: Point) -> tuple[FloatArray, FloatArray]:
    """Matrix of the normal equations with the prior of theta, columns scaled, and the scales."""
    P = len(point.theta)
    normal = lin.jacobian.T @ lin.jacobian
    normal[np.arange(P), np.arange(P)] += 1 / PRIOR**2
    scale = scale_of(normal, len(point.state))
    return normal * scale * scale[:, None], scale


def _step(lin: Linearisation, point: Point, damping: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step and the standard deviations of theta and term parameters."""
    P = len(point.theta)
    scaled, scale = _normal(lin, point)
    gradient = lin.jacobian.T @ lin.residual
    gradient[: len(lin.log_det_slope)] -= lin.log_det_slope / 2
    gradient[:P] -= point.theta / PRIOR**2
    scaled[np.diag_indices_from(scaled)] += damping + 1e-13
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    step = scale * (inverse @ (gradient * scale))
    held = held_back(point, step)
    if held.any():  # the others go on as if it were given
        scaled[held], scaled[:, held], gradient[held] = 0.0, 0.0, 0.0
        inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
        step = scale * (inverse @ (gradient * scale))
    free = len(scaled) - len(point.state)
    sigma = (scale * np.sqrt(np.maximum(np.diag(inverse), 1e-300)))[:free]
    return step, sigma


def _finish(problem: Problem, point: Point, lin: Linearisation, converged: bool, count: int) -> Fit:
    P = len(point.theta)
    free = lin.jacobian.shape[1] - len(point.state)
    scaled, scale = _normal(lin, point)
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    covariance = (inverse * scale * scale[:, None])[:free, :free]
    slopes = np.concatenate([np.ones(P), *[t.slopes for t in point.terms]]) if point.terms else np.ones(P)
    covariance = covariance * slopes * slopes[:, None]
    return Fit(
        point=replace(point, near=near_of(lin.forces)),
        chi_square=float(lin.residual @ lin.residual),
        log_det=lin.log_det,
        log_det_slope=lin.log_det_slope,
        noise=problem.noise,
        count=len(lin.residual),
        covariance=covariance,
        residual=lin.residual,
        jacobian=lin.jacobian,
        spectrum=lin.spectrum,
        forward=lin.forward,
        forces=lin.forces,
        motions=lin.motions,
        converged=converged,
        iterations=count,
        bounded=any(t.bounded for t in point.terms),
    )
