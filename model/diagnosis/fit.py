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

from model.diagnosis.columns import Columns, loads_of
from model.diagnosis.forward import Forward, LawForces, Loop, fixed_point
from model.diagnosis.hysteresis import force_along
from model.diagnosis.measured import Noise, Part
from model.diagnosis.motions import Motions, motions_of
from model.diagnosis.point import Point, advance
from model.diagnosis.preload import preloaded
from model.diagnosis.spectra import OVERSAMPLING, ComplexArray
from model.diagnosis.tangent import Taken, law_change, port_motions, step_of, tangent
from model.diagnosis.terms import Term, is_waveform
from model.diagnosis.whiten import Whitener
from model.signals import FloatArray
from model.system import System

PRIOR = 1.0  # standard deviation of a log-ratio to nominal: keeps what nothing tells near its nominal value
_SLACK = 5e-4  # of the objective: inputs are smoothed again and loops solved again in every round
_FOLLOWED = 1e-4  # of the laws' forces along a smoothed motion, which is no better known
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding


@dataclass(frozen=True)
class Smoothed:
    """Inputs as the sensors ask for them within their noise."""

    part: Part
    force: FloatArray | None = None  # of the laws along the motion that results, (4N, m)


@dataclass(frozen=True)
class Change:
    """What one more of a parameter does."""

    shown: ComplexArray  # to the sensors, (F, S)
    log_det: float = 0.0  # to the residual's covariance
    motion: FloatArray | None = None  # to deflection and rate along the laws' ports, forces held, (2, N, m)


@dataclass(frozen=True)
class Linearisation:
    """Residual and sensitivities at a point, whitened."""

    residual: FloatArray  # (R,)
    jacobian: FloatArray  # of the model, columns theta, term parameters (internal scale), state: (R, P + p + 2n)
    log_det: float  # of the residual's covariance
    log_det_slope: FloatArray  # by theta and term parameters, (P + p,)
    spectrum: ComplexArray  # the residual itself, (F, S)
    forward: Forward
    forces: LawForces | None
    motions: Motions


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
        return len(self.noise.force) > 0

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
        polynomial = plant.polynomial_sensors(forward.polynomial[0], part.support_polynomial)
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
        plant, part, smoothed = forward.plant, self.part, forward.part
        supports = np.einsum("fsi,fi->fs", plant.sensor_of_support, part.support - smoothed.support)
        forces = part.force - smoothed.force
        forces[0] += (part.force_polynomial - smoothed.force_polynomial)[0] * np.sqrt(part.grid.samples)
        forces = forces / forward.force_faults[0]
        return supports + np.einsum("fsi,fi->fs", plant.sensor_of_measured_force, forces)

    def linearise(self, point: Point) -> Linearisation:
        """Residual and sensitivities at a point."""
        shown, forward, forces = self.predict(point)
        grid = self.part.grid
        if self.whitener is None:
            self.whitener = Whitener.of(forward, self.noise)
        free = self._free_columns(forward)
        spectrum = self.part.sensors - shown - free @ point.state
        motions = motions_of(forward, forces, point.state)
        P = len(point.theta)
        count = P + sum(len(t.parameters) for t in point.terms)
        theta_forces, theta_loads = self._theta_forces(forward, motions)
        law_forces = np.zeros((len(grid.omega), count - P, 0 if forces is None else len(forces.terms)), dtype=complex)
        packed = Columns(self, forward, count + free.shape[2])
        for i, parameter in enumerate(self.system.parameters):
            if parameter.quantity == "mass":
                packed.add_load(i, theta_loads[i])
            else:
                packed.add_force(i, self.system.elements.index(parameter.element), theta_forces[:, i])
        at, loads = P, dict(theta_loads)
        slopes = np.zeros(count)
        shifts: dict[int, FloatArray] = {}
        if self.follows:
            slopes[:P] = self._log_det_slopes(forward)
        for index, term in enumerate(point.terms):
            for j in range(len(term.parameters)):
                if forward.faulty_force(term) is not None:
                    loads[at] = forward.driven_by(self.part).fault_load(term)
                    packed.add_load(at, loads[at])
                elif is_waveform(term):
                    assert forces is not None
                    port, change = law_change(forward, forces, term, j)
                    law_forces[:, at - P, port] = change
                    packed.add_port(at, forces.ports[port], change)
                else:
                    effect = self._difference(point, index, j, forward, forces, shown)
                    packed.add_shown(at, effect.shown)
                    slopes[at] = effect.log_det
                    if effect.motion is not None:
                        shifts[at] = effect.motion
                at += 1
        packed.add_free(count, free)
        if forces is not None:
            along = port_motions(forward, forces, theta_forces, loads, law_forces, free.shape[2])
            for column, motion in shifts.items():
                along[..., column] = motion
            taken = Taken(self, forward, forces) if self.follows else None
            if taken is not None:
                along = along - taken.motion(packed.whitened)
            extra = tangent(forward, forces, along, taken)
            for k, port in enumerate(forces.ports):
                for column in range(extra.shape[2]):
                    packed.add_port(column, port, extra[:, k, column])
        residual = self.whitener(spectrum, self.part)
        return Linearisation(
            residual, packed.jacobian, self.whitener.log_det, slopes, spectrum, forward, forces, motions
        )

    def _free_columns(self, forward: Forward) -> ComplexArray:
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

    def _theta_forces(self, forward: Forward, motions: Motions) -> tuple[ComplexArray, dict[int, ComplexArray]]:
        """Forces along the own element that act like a rise of log k (log c): (F, P); loads (F, n) of log masses."""
        omega, structure = forward.plant.grid.omega, forward.plant.structure
        forces = np.zeros((len(omega), len(self.system.parameters)), dtype=complex)
        loads = {}
        for i, parameter in enumerate(self.system.parameters):
            if parameter.quantity == "mass":
                dofs = structure.body_of_dof == self.system.bodies.index(parameter.element)
                loads[i] = np.where(dofs, -structure.mass * motions.acceleration, 0.0)
                continue
            value = parameter.nominal * np.exp(forward.theta[i])
            element = self.system.elements.index(parameter.element)
            along = motions.rate if parameter.quantity == "damping" else motions.deflection
            forces[:, i] = value * along[:, element]
            for branch in structure.branches if parameter.quantity == "damping" else ():
                if branch.element == element and branch.replaces:  # c s / (1 + s c / ks) by log c
                    forces[:, i] /= (1 + 1j * omega * branch.time) ** 2
        return forces, loads

    def _difference(
        self,
        point: Point,
        index: int,
        parameter: int,
        forward: Forward,
        forces: LawForces | None,
        shown: ComplexArray,
    ) -> Change:
        """What one more of a term's parameter does, by a finite difference of the model.

        Forces along a smoothed motion are held: how they answer is the tangent's matter.
        """
        term = point.terms[index]
        step = step_of(term, parameter)
        moved = term.moved(parameter, step)
        terms = tuple(moved if k == index else t for k, t in enumerate(point.terms))
        other, other_forward, other_forces = self.predict(replace(point, terms=terms, near=_start(forces)))
        free = other_forward.free_rows() - forward.free_rows()
        change = (other - shown + self.part.grid.forward(free @ point.state)) / step
        if not self.follows:
            return Change(change)
        assert self.whitener is not None
        log_det = (Whitener.of(other_forward, self.noise).log_det - self.whitener.log_det) / step
        if forces is None or other_forces is None:
            return Change(change, log_det)
        thin = slice(None, None, OVERSAMPLING)
        motion = [other_forces.deflection - forces.deflection, other_forces.rate - forces.rate]
        return Change(change, log_det, np.stack(motion)[:, thin] / step)

    def _log_det_slopes(self, forward: Forward) -> FloatArray:
        """Rise of the residual's log determinant with every log-ratio, (P,): inputs' noise goes through the plant."""
        assert self.whitener is not None
        plant, band = forward.plant, self.part.grid.band
        jw = 1j * plant.grid.omega[band, None]
        shown = forward.sensor_factor[band, :, None]
        deflection = np.concatenate([plant.deflection_of_support, plant.deflection_of_measured_force], axis=2)[band]
        slopes = np.zeros(len(self.system.parameters))
        for i, parameter in enumerate(self.system.parameters):
            value = parameter.nominal * np.exp(forward.theta[i])
            if parameter.quantity == "mass":
                dofs = plant.structure.body_of_dof == self.system.bodies.index(parameter.element)
                change = forward.inputs_by_mass(dofs)[band]
            else:
                element = self.system.elements.index(parameter.element)
                factor = value * (jw if parameter.quantity == "damping" else 1.0)
                along = plant.sensor_of_force[band][:, :, element, None] * (factor * deflection[:, element])[:, None]
                change = along * shown
            slopes[i] = self.whitener.log_det_slope(change)
        return slopes

    def smooth(self, point: Point, last: Linearisation | None = None) -> Point:
        """Smooth the inputs at a point near the last one: what of the residual their noise explains is taken for it.

        Returns the point, where the system has measured forces with its starting state fitted anew.
        """
        if self.follows:
            return self._along_measured_motion(point)
        if last is not None:  # the noise of supports is small: the last residual tells it well enough
            self.smoothed = Smoothed(self._smoothed(last.spectrum))
        return point

    def shown_by_motion(self, fit: Fit) -> ComplexArray:
        """What the sensors show of a fit's smoothed motion, (F, S)."""
        shown = self.part.sensors - fit.spectrum
        if fit.forward.part is self.part:
            return shown
        return shown - self._of_input_noise(fit.forward) * fit.forward.sensor_factor

    def _along_measured_motion(self, point: Point) -> Point:
        """Smooth measured forces, with laws along the motion that results.

        A measured force takes the blame for whatever else pushes the body, so its noise is large and the smoothed
        motion is the one that the sensors saw, not a free run.  Laws' forces, state and smoothed inputs depend on each
        other; they are iterated like the forces of a free run.
        """
        part = self.part
        forward = Forward(self.system, part, self.sensors, point.theta, point.terms)
        self.whitener = whitener = Whitener.of(forward, self.noise)  # noise goes through the plant as it is now
        free = self._free_columns(forward)
        columns = whitener(free, part)
        scale = _scale(columns.T @ columns, columns.shape[1])
        of_residual = scale[:, None] * np.linalg.pinv(columns * scale, rcond=1e-9)

        def smoothed(forces: LawForces | None) -> tuple[FloatArray, Part]:
            spectrum = part.sensors - self.shown(forward, forces)
            state = of_residual @ whitener(spectrum, part)
            return state, self._smoothed(spectrum - free @ state)

        loop = forward.loop(point.state)
        if loop is None:
            state, inputs = smoothed(None)
            self.smoothed = Smoothed(inputs)
            return replace(point, state=state)

        def along(force: FloatArray, loop: Loop = loop) -> FloatArray:
            state, inputs = smoothed(loop.answer(force))
            driven = loop.driven(forward.driven_by(inputs), state)
            return driven.law(*driven.motion(force))

        start = np.column_stack(point.near) if point.near else along(np.zeros((len(loop.d0), len(loop.terms))))
        force, _ = fixed_point(along, start, _FOLLOWED)
        state, inputs = smoothed(loop.answer(force))
        self.smoothed = Smoothed(inputs, force)
        return replace(point, state=state, near=tuple(force.T))

    def _smoothed(self, spectrum: ComplexArray) -> Part:
        """The part with its inputs as a residual (F, S) asks for."""
        assert self.whitener is not None
        part, band = self.part, self.part.grid.band
        whitened = (self.whitener.factor @ spectrum[band, :, None])[:, :, 0]
        size = np.mean(np.abs(whitened) ** 2, axis=1)
        width = 21
        local = np.convolve(np.pad(size, width // 2, mode="edge"), np.ones(width) / width, mode="valid")
        shift = np.einsum("fis,fs->fi", self.whitener.blame, whitened)
        support, force = part.support.copy(), part.force.copy()
        count = support.shape[1]
        support[band] += shift[:, :count] / np.maximum(1.0, local)[:, None]
        force[band] += shift[:, count:]
        steady = part.force_polynomial.copy()  # moves a floating system steadily, which its spectrum cannot
        steady[0] += np.real(force[0] - part.force[0]) / np.sqrt(part.grid.samples)
        force[0] = part.force[0]
        return replace(part, support=support, force=force, force_polynomial=steady)

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
                point, lin, best, kept = (
                    replace(trial, near=_start(proposal.forces)),
                    proposal,
                    value,
                    (self.whitener, self.smoothed),
                )
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


def _start(forces: LawForces | None) -> tuple[FloatArray, ...]:
    return () if forces is None else tuple(forces.force.T)


def _objective(lin: Linearisation, point: Point) -> float:
    return float(lin.residual @ lin.residual + lin.log_det + np.sum((point.theta / PRIOR) ** 2))


def _step(lin: Linearisation, point: Point, damping: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step and the standard deviations of theta and term parameters."""
    P = len(point.theta)
    normal = lin.jacobian.T @ lin.jacobian
    gradient = lin.jacobian.T @ lin.residual
    gradient[: len(lin.log_det_slope)] -= lin.log_det_slope / 2
    normal[np.arange(P), np.arange(P)] += 1 / PRIOR**2
    gradient[:P] -= point.theta / PRIOR**2
    scale = _scale(normal, len(point.state))
    scaled = normal * scale * scale[:, None]
    scaled[np.diag_indices_from(scaled)] += damping + 1e-13
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    step = scale * (inverse @ (gradient * scale))
    free = len(normal) - len(point.state)
    sigma = (scale * np.sqrt(np.maximum(np.diag(inverse), 1e-300)))[:free]
    return step, sigma


def _scale(normal: FloatArray, states: int) -> FloatArray:
    """What brings the diagonal of normal equations to one; zero for a state at the end of it that leaves no trace.

    Where a body floats, its starting position leaves none in rates and accelerations.
    """
    size = np.diag(normal)
    seen = np.ones(len(size), dtype=bool)
    seen[-states:] = size[-states:] > _UNSEEN * size[-states:].max()
    return np.where(seen, 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)


def _finish(problem: Problem, point: Point, lin: Linearisation, converged: bool, count: int) -> Fit:
    P = len(point.theta)
    free = lin.jacobian.shape[1] - len(point.state)
    normal = lin.jacobian.T @ lin.jacobian
    normal[np.arange(P), np.arange(P)] += 1 / PRIOR**2
    scale = _scale(normal, len(point.state))
    inverse = np.linalg.pinv(normal * scale * scale[:, None], rcond=1e-14, hermitian=True)
    covariance = (inverse * scale * scale[:, None])[:free, :free]
    slopes = np.concatenate([np.ones(P), *[t.slopes for t in point.terms]]) if point.terms else np.ones(P)
    covariance = covariance * slopes * slopes[:, None]
    return Fit(
        point=replace(point, near=_start(lin.forces)),
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
