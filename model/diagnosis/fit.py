"""Maximum likelihood of parameters, terms and starting state on one part of a recording.

Residual of bin w:   r = y - Y(theta, terms, x0; u),   covariance  R = diag(s^2) + G S_u G^H,

with G from the measured inputs to the sensors and S_u the inputs' noise.  Minimising r^H R^-1 r over the parameters
is the functional maximum likelihood of an errors-in-variables model, the true inputs being profiled out:
u = u_m + S_u G^H R^-1 r.  Gauss-Newton with the sensitivities taken at that smoothed input is free of the
attenuation bias that noisy regressors cause (Soderstrom 2007).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from model.diagnosis.catalogue import ElementLaw
from model.diagnosis.forward import Forward, LawForces
from model.diagnosis.hysteresis import force_along
from model.diagnosis.measured import Noise, Part
from model.diagnosis.spectra import OVERSAMPLING, ComplexArray
from model.diagnosis.terms import Term, is_waveform
from model.signals import FloatArray
from model.system import System

PRIOR = 1.0  # standard deviation of a log-ratio to nominal: keeps what nothing tells near its nominal value
_RELATIVE_STEP = 1e-4  # of finite differences


@dataclass(frozen=True)
class Whitener:
    """Inverse Cholesky factors of the residual's covariance on the compared bins."""

    factor: ComplexArray  # (F, S, S)
    smoother: ComplexArray  # S_u G^H R^-1 of supports then forces, (F, inputs, S)

    @classmethod
    def of(cls, forward: Forward, noise: Noise) -> Whitener:
        """Covariance from the sensors' noise and from the inputs' noise through the model."""
        part, plant = forward.part, forward.plant
        band = part.grid.band
        G = plant.sensor_of_support[band]
        variance = noise.support_variance(part.grid.omega[band])
        if part.force.shape[1]:
            F = plant.structure.F[:, : part.force.shape[1]]
            G = np.concatenate([G, plant.sensor_of_load[band] @ F], axis=2)
            more = np.broadcast_to(noise.force**2, (len(G), part.force.shape[1]))
            variance = np.concatenate([variance, more], axis=1)
        G = G * forward.sensor_factor[band, :, None]
        weighted = G * variance[:, None, :]
        R = weighted @ G.conj().transpose(0, 2, 1)
        index = np.arange(R.shape[1])
        R[:, index, index] += noise.sensors**2
        factor = np.linalg.inv(np.linalg.cholesky(R))
        precision = factor.conj().transpose(0, 2, 1) @ factor
        return cls(factor, weighted.conj().transpose(0, 2, 1) @ precision)

    def __call__(self, spectrum: ComplexArray, part: Part) -> FloatArray:
        """(F, S) or (F, S, m) -> real unit-noise vectors (2 F S,) or (2 F S, m)."""
        band = spectrum[part.grid.band]
        if band.ndim == 2:
            return part.grid.pack((self.factor @ band[:, :, None])[:, :, 0])
        return part.grid.pack(self.factor @ band)


@dataclass(frozen=True)
class Point:
    """Values of everything that is free."""

    theta: FloatArray  # (P,)
    terms: tuple[Term, ...]
    state: FloatArray  # (2n,)


@dataclass(frozen=True)
class Linearisation:
    """Residual and sensitivities at a point, whitened."""

    residual: FloatArray  # (R,)
    jacobian: FloatArray  # of the model, columns theta, term parameters (internal scale), state: (R, P + p + 2n)
    spectrum: ComplexArray  # the residual itself, (F, S)
    forward: Forward
    forces: LawForces | None
    deflections: ComplexArray  # of the elements, whole, (F, E)


@dataclass(frozen=True)
class Fit:
    """A maximum-likelihood fit."""

    point: Point
    chi_square: float  # r^T r
    count: int  # real residuals
    covariance: FloatArray  # of theta and the term parameters, (P + p, P + p)
    residual: FloatArray  # whitened, (R,)
    jacobian: FloatArray  # (R, P + p + 2n)
    spectrum: ComplexArray  # unwhitened residual, (F, S)
    forward: Forward
    forces: LawForces | None
    deflections: ComplexArray
    converged: bool
    iterations: int
    bounded: bool = False  # a law's parameter stopped at its bound

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
    smoothed: ComplexArray | None = None  # fused support displacements after smoothing, (F, supports)
    cache: dict = field(default_factory=dict)

    def forward(self, point: Point, start: tuple[FloatArray, ...] = ()) -> Forward:
        part = self.part if self.smoothed is None else replace(self.part, support=self.smoothed)
        return Forward(self.system, part, self.sensors, point.theta, point.terms, start)

    def predict(
        self, point: Point, start: tuple[FloatArray, ...] = ()
    ) -> tuple[ComplexArray, Forward, LawForces | None]:
        """Shown sensor signals, (F, S)."""
        forward = self.forward(point, start)
        forces = forward.law_forces(point.state)
        periodic = forward.linear_sensors
        if self.smoothed is not None:
            noise = self.part.support - self.smoothed
            periodic = periodic + np.einsum("fsi,fi->fs", forward.plant.sensor_of_support, noise)
        polynomial = forward.plant.polynomial_sensors(forward.polynomial[0], self.part.support_polynomial)
        if forces is not None:
            periodic = periodic + forces.sensors
            still = np.zeros_like(self.part.support_polynomial)
            polynomial = polynomial + forward.plant.polynomial_sensors(forces.motion, still)
        shown = forward.shown(periodic, polynomial)
        for term in point.terms:
            shown = shown + _loads(forward, term)
        return shown, forward, forces

    def linearise(self, point: Point, start: tuple[FloatArray, ...] = ()) -> Linearisation:
        """Residual and sensitivities at a point."""
        shown, forward, forces = self.predict(point, start)
        grid = self.part.grid
        free = grid.forward(forward.free_rows())
        spectrum = self.part.sensors - shown - free @ point.state
        if self.whitener is None:
            self.whitener = Whitener.of(forward, self.noise)
        deflections, motion = _motions(forward, forces, point.state)
        columns = [self._theta_columns(forward, deflections, motion)]
        for index, term in enumerate(point.terms):
            columns.append(self._term_columns(point, index, term, forward, forces, shown))
        columns.append(free)
        jacobian = self.whitener(np.concatenate(columns, axis=2), self.part)
        residual = self.whitener(spectrum, self.part)
        return Linearisation(residual, jacobian, spectrum, forward, forces, deflections)

    def _theta_columns(
        self, forward: Forward, deflections: ComplexArray, motion: ComplexArray
    ) -> ComplexArray:
        """Sensitivity to log k (log c) of an element: a force along it equal to -k d (-c v) of its own; (F, S, P)."""
        system, plant = self.system, forward.plant
        structure = plant.structure
        columns = np.empty((len(deflections), len(self.sensors), len(system.parameters)), dtype=complex)
        for i, parameter in enumerate(system.parameters):
            value = parameter.nominal * np.exp(forward.theta[i])
            if parameter.quantity == "mass":
                dofs = structure.body_of_dof == system.bodies.index(parameter.element)
                inertia = -(plant.grid.omega[:, None] ** 2) * motion[:, dofs] * structure.mass[dofs]
                columns[:, :, i] = -np.einsum("fsn,fn->fs", plant.sensor_of_load[:, :, dofs], inertia)
                continue
            e = system.elements.index(parameter.element)
            force = value * deflections[:, e]
            if parameter.quantity == "damping":
                force = force * 1j * plant.grid.omega
            columns[:, :, i] = plant.sensor_of_force[:, :, e] * force[:, None]
        return columns * forward.sensor_factor[:, :, None]

    def _term_columns(
        self,
        point: Point,
        index: int,
        term: Term,
        forward: Forward,
        forces: LawForces | None,
        shown: ComplexArray,
    ) -> ComplexArray:
        """Sensitivity to the internal parameters of one term, (F, S, p)."""
        columns = []
        values = np.array(term.parameters)
        for j in range(len(values)):
            step = _RELATIVE_STEP * (1.0 if term.law.parameters[j].log else max(abs(values[j]), term.scales[j]))
            moved = term.moved(j, step)
            if is_waveform(term):
                assert forces is not None
                change = (_force(forward, moved, forces) - _force(forward, term, forces)) / step
                spectrum = forward.part.grid.coarse_spectrum(change)
                port = np.pad(term.port(self.system), (0, forward.plant.structure.H.shape[0] - forward.elements))
                column = (forward.plant.sensor_of_force @ port) * spectrum[:, None] * forward.sensor_factor
            else:
                terms = tuple(moved if k == index else t for k, t in enumerate(point.terms))
                other, other_forward, _ = self.predict(replace(point, terms=terms), _start(forces))
                column = (other - shown) / step
                if other_forward.plant.structure.mass.shape == forward.plant.structure.mass.shape:
                    grid = self.part.grid
                    free = other_forward.free_rows() - forward.free_rows()
                    column = column + grid.forward(free @ point.state) / step
            columns.append(column)
        if not columns:
            return np.zeros((*shown.shape, 0), dtype=complex)
        return np.stack(columns, axis=2)

    def smooth(self, spectrum: ComplexArray, residual: FloatArray) -> None:
        """Update the smoothed inputs from a residual; where the model misfits, the noise keeps its prior size."""
        if self.whitener is None or not self.part.support.shape[1]:
            return
        band = self.part.grid.band
        size = (residual.reshape(2, band.stop, -1) ** 2).mean(axis=(0, 2))
        width = 21
        local = np.convolve(np.pad(size, width // 2, mode="edge"), np.ones(width) / width, mode="valid")
        shift = np.einsum("fis,fs->fi", self.whitener.smoother, spectrum[band])
        shift = shift[:, : self.part.support.shape[1]] / np.maximum(1.0, local)[:, None]
        self.smoothed = self.part.support.copy()
        self.smoothed[band] += shift

    def fit(self, start: Point, iterations: int = 12, tolerance: float = 1e-3) -> Fit:
        """Gauss-Newton with Levenberg damping from `start`; stops when no parameter moves by `tolerance` std."""
        point = _preloaded(self, start)
        lin = self.linearise(point)
        best = _objective(lin.residual, point)
        damping, converged, count = 1e-6, False, 0
        for count in range(1, iterations + 1):
            step, sigma = _step(lin.jacobian, lin.residual, point, damping)
            trial = _advance(point, step)
            size = float(np.max(np.abs(step[: len(sigma)]) / sigma)) if len(sigma) else 0.0
            self.smooth(lin.spectrum, lin.residual)
            proposal = self.linearise(trial, _start(lin.forces))
            value = _objective(proposal.residual, trial)
            if value <= best + 1e-6 * best or size < tolerance:
                gained = best - value
                point, lin, best = trial, proposal, value
                damping = max(damping / 10, 1e-9)
                if size < tolerance or (gained < 0.01 and size < 0.1):
                    converged = True
                    break
                if count in (2, 4):
                    point = _preloaded(self, point)
            else:
                damping = max(damping * 30, 1e-4)
                if damping > 1e3:
                    break
        return _finish(self, point, lin, converged, count)


def _loads(forward: Forward, term: Term) -> ComplexArray | float:
    """Sensor signals of a body's unmeasured force."""
    load = getattr(term.law, "load", None)
    if load is None or isinstance(term.law, ElementLaw):
        return 0.0
    grid = forward.part.grid
    from model.diagnosis.catalogue import CLOCK_LEAD

    series = load(grid.start + grid.time + CLOCK_LEAD, term.parameters)
    dof = forward.system.mechanics.dofs.index(f"{term.location}.{term.variant}")
    spectrum = grid.forward(series)
    return forward.plant.sensor_of_load[:, :, dof] * spectrum[:, None] * forward.sensor_factor


def _force(forward: Forward, term: Term, forces: LawForces) -> FloatArray:
    i = next(k for k, t in enumerate(forces.terms) if t.key == term.key)
    grid = forward.part.grid
    return force_along(
        term.law,  # type: ignore[arg-type]
        term.parameters,
        forces.deflection[:, i],
        forces.rate[:, i],
        grid.start + grid.fine_time,
        forward.element_of(term),
    )


def _motions(
    forward: Forward, forces: LawForces | None, state: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Whole spectra of deflections (F, elements) and of the degrees of freedom (F, n)."""
    plant, grid, part = forward.plant, forward.part.grid, forward.part
    s = plant.structure
    n = len(s.mass)
    q_poly, d_poly = forward.polynomial
    deflections = forward.linear_deflection + grid.monomial_spectra @ d_poly
    needs_motion = any(p.quantity == "mass" for p in forward.system.parameters)
    from model.diagnosis.forward import _propagate

    free = _propagate(s.state_matrix(), np.eye(n, 2 * n), state, grid.step, grid.samples)
    free_spectrum = grid.forward(free)
    deflections = deflections + free_spectrum @ s.H.T
    motion = np.zeros((0, 0), dtype=complex)
    if forces is not None:
        deflections = deflections + forces.deflections + grid.monomial_spectra @ (forces.motion @ s.H.T)
    if needs_motion:
        loads = -(plant.impedance[:, None, :] * s.H.T) @ s.G if part.support.shape[1] else None
        motion = grid.monomial_spectra @ q_poly + free_spectrum
        if loads is not None:
            motion = motion + np.einsum("fnm,fmi,fi->fn", plant.receptance, loads, part.support, optimize=True)
        if part.force.shape[1]:
            F = s.F[:, : part.force.shape[1]]
            motion = motion + np.einsum("fnm,fm->fn", plant.receptance, part.force @ F.T)
        if forces is not None:
            motion = motion + forces.q + grid.monomial_spectra @ forces.motion
    return deflections[:, : forward.elements], motion


def _preloaded(problem: Problem, point: Point) -> Point:
    """The point with the laws' equivalent stiffness and damping moved into the plant."""
    if not any(is_waveform(t) and "|" not in t.location for t in point.terms):
        return point
    bare = replace(point, terms=tuple(replace(t, preload=(0.0, 0.0)) for t in point.terms))
    forward = problem.forward(point)
    forces = forward.law_forces(point.state)
    assert forces is not None
    terms = []
    for term in bare.terms:
        if is_waveform(term) and "|" not in term.location:
            i = next(k for k, t in enumerate(forces.terms) if t.key == term.key)
            thin = slice(None, None, OVERSAMPLING)
            regressors = np.column_stack([forces.deflection[thin, i], forces.rate[thin, i]])
            f = _force(forward, term, forces)[thin]
            element = forward.element_of(term)
            k, c = np.linalg.lstsq(regressors, f, rcond=None)[0]
            k = max(k, -0.9 * element.stiffness) if element.stiffness else 0.0
            term = replace(term, preload=(float(k), float(max(c, -0.9 * element.damping))))
        terms.append(term)
    return replace(point, terms=tuple(terms))


def _start(forces: LawForces | None) -> tuple[FloatArray, ...]:
    return () if forces is None else tuple(forces.force.T)


def _objective(residual: FloatArray, point: Point) -> float:
    return float(residual @ residual + np.sum((point.theta / PRIOR) ** 2))


def _step(
    jacobian: FloatArray, residual: FloatArray, point: Point, damping: float
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step and the standard deviations of theta and term parameters."""
    P = len(point.theta)
    normal = jacobian.T @ jacobian
    gradient = jacobian.T @ residual
    normal[np.arange(P), np.arange(P)] += 1 / PRIOR**2
    gradient[:P] -= point.theta / PRIOR**2
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale * scale[:, None]
    scaled[np.diag_indices_from(scaled)] += damping + 1e-13
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    step = scale * (inverse @ (gradient * scale))
    free = len(normal) - len(point.state)
    sigma = (scale * np.sqrt(np.maximum(np.diag(inverse), 1e-300)))[:free]
    return step, sigma


def _advance(point: Point, step: FloatArray) -> Point:
    P = len(point.theta)
    theta = point.theta + np.clip(step[:P], -1.0, 1.0)
    at, terms = P, []
    for term in point.terms:
        count = len(term.parameters)
        terms.append(term.advanced(step[at : at + count]))
        at += count
    return Point(theta, tuple(terms), point.state + step[at:])


def _finish(problem: Problem, point: Point, lin: Linearisation, converged: bool, count: int) -> Fit:
    P = len(point.theta)
    free = lin.jacobian.shape[1] - len(point.state)
    normal = lin.jacobian.T @ lin.jacobian
    normal[np.arange(P), np.arange(P)] += 1 / PRIOR**2
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * scale * scale[:, None], rcond=1e-14, hermitian=True)
    covariance = (inverse * scale * scale[:, None])[:free, :free]
    slopes = np.concatenate([np.ones(P), *[t.slopes for t in point.terms]]) if point.terms else np.ones(P)
    covariance = covariance * slopes * slopes[:, None]
    return Fit(
        point=point,
        chi_square=float(lin.residual @ lin.residual),
        count=len(lin.residual),
        covariance=covariance,
        residual=lin.residual,
        jacobian=lin.jacobian,
        spectrum=lin.spectrum,
        forward=lin.forward,
        forces=lin.forces,
        deflections=lin.deflections,
        converged=converged,
        iterations=count,
        bounded=any(t.bounded for t in point.terms),
    )
