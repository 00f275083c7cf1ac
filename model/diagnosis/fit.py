"""Maximum likelihood of parameters, terms and starting state on one part of a recording.

Residual of bin w:   r = y - Y(theta, terms, x0; u),   covariance  R = diag(s^2) + G S_u G^H,

with G from the measured inputs to the sensors and S_u the inputs' noise.  Minimising r^H R^-1 r over the parameters
is the functional maximum likelihood of an errors-in-variables model, the true inputs being profiled out:
u = u_m + S_u G^H R^-1 r.  Gauss-Newton with the sensitivities taken at that smoothed input is free of the
attenuation bias that noisy regressors cause (Soderstrom 2007).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from model.diagnosis.catalogue import ElementLaw
from model.diagnosis.forward import Forward, LawForces, propagate
from model.diagnosis.hysteresis import force_along
from model.diagnosis.measured import Noise, Part
from model.diagnosis.spectra import DEGREE, OVERSAMPLING, ComplexArray
from model.diagnosis.terms import Term, is_waveform
from model.diagnosis.unknown import StaticLaw
from model.signals import FloatArray
from model.system import System

PRIOR = 1.0  # standard deviation of a log-ratio to nominal: keeps what nothing tells near its nominal value
_SLACK = 5e-4  # of the objective: inputs are smoothed again and loops solved again in every round
_PRELOADS = 4  # rounds of equivalent law and motion
_SMOOTHINGS = 3  # rounds of smoothed inputs and the laws' forces along the smoothed motion
_KRYLOV, _KRYLOV_TOLERANCE = 16, 3e-3
_UNSEEN = 1e-26  # of the largest squared sensitivity to a state: rounding
_RELATIVE_STEP = 1e-4  # of finite differences


@dataclass(frozen=True)
class Whitener:
    """Inverse Cholesky factors of the residual's covariance on the compared bins."""

    factor: ComplexArray  # (F, S, S)
    blame: ComplexArray  # whitened residual to the inputs' share of it, supports then forces, (F, inputs, S)

    @classmethod
    def of(cls, forward: Forward, noise: Noise) -> Whitener:
        """Covariance from the sensors' noise and from the inputs' noise through the model."""
        part, plant = forward.part, forward.plant
        band = part.grid.band
        G = plant.sensor_of_support[band]
        variance = noise.support_variance(part.grid.omega[band])
        G = np.concatenate([G, plant.sensor_of_measured_force[band]], axis=2)
        variance = np.concatenate([variance, np.broadcast_to(noise.force**2, (len(G), len(noise.force)))], axis=1)
        G = G * forward.sensor_factor[band, :, None]
        weighted = G * variance[:, None, :]
        R = weighted @ G.conj().transpose(0, 2, 1)
        index = np.arange(R.shape[1])
        R[:, index, index] += noise.sensor_variance(part.grid, part.rated)[band]
        factor = np.linalg.inv(np.linalg.cholesky(R))
        return cls(factor, (factor @ weighted).conj().transpose(0, 2, 1))

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
    state: FloatArray  # (2n + b,)
    near: tuple[FloatArray, ...] = ()  # the laws' forces on a trajectory nearby, each (4N,), to start from


@dataclass(frozen=True)
class Linearisation:
    """Residual and sensitivities at a point, whitened."""

    residual: FloatArray  # (R,)
    jacobian: FloatArray  # of the model, columns theta, term parameters (internal scale), state: (R, P + p + 2n)
    spectrum: ComplexArray  # the residual itself, (F, S)
    forward: Forward
    forces: LawForces | None
    motions: Motions


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
    motions: Motions
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
    smoothed: Part | None = None  # the part with its inputs after smoothing
    cache: dict = field(default_factory=dict)

    def forward(self, point: Point, start: tuple[FloatArray, ...] = ()) -> Forward:
        part = self.smoothed or self.part
        return Forward(self.system, part, self.sensors, point.theta, point.terms, start or point.near)

    def predict(
        self, point: Point, start: tuple[FloatArray, ...] = ()
    ) -> tuple[ComplexArray, Forward, LawForces | None]:
        """Shown sensor signals, (F, S)."""
        forward = self.forward(point, start)
        forces = forward.law_forces(point.state)
        return self._shown(forward, forces), forward, forces

    def _shown(self, forward: Forward, forces: LawForces | None) -> ComplexArray:
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
            shown = shown + _loads(forward, term)
        return shown

    def _of_input_noise(self, forward: Forward) -> ComplexArray:
        """What the linear plant makes of the measured inputs less the smoothed ones, (F, S)."""
        plant, part, smoothed = forward.plant, self.part, forward.part
        supports = np.einsum("fsi,fi->fs", plant.sensor_of_support, part.support - smoothed.support)
        forces = part.force - smoothed.force
        forces[0] += (part.force_polynomial - smoothed.force_polynomial)[0] * np.sqrt(part.grid.samples)
        forces = forces / forward.force_faults[0]
        return supports + np.einsum("fsi,fi->fs", plant.sensor_of_measured_force, forces)

    def linearise(self, point: Point, start: tuple[FloatArray, ...] = ()) -> Linearisation:
        """Residual and sensitivities at a point."""
        shown, forward, forces = self.predict(point, start)
        grid = self.part.grid
        if self.whitener is None:
            self.whitener = Whitener.of(forward, self.noise)
        free = self._free_columns(forward)
        spectrum = self.part.sensors - shown - free @ point.state
        motions = _motions(forward, forces, point.state)
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
        at = P
        for index, term in enumerate(point.terms):
            for j in range(len(term.parameters)):
                if is_waveform(term):
                    assert forces is not None
                    port, change = _law_change(forward, forces, term, j)
                    law_forces[:, at - P, port] = change
                    packed.add_port(at, forces.ports[port], change)
                else:
                    packed.add_shown(at, self._difference(point, index, j, forward, forces, shown))
                at += 1
        packed.add_free(count, free)
        if forces is not None:
            along = _port_motions(forward, forces, theta_forces, theta_loads, law_forces, free.shape[2])
            taken = Taken(self, forward, forces) if len(self.noise.force) else None
            if taken is not None:
                along = along - taken.motion(packed.whitened)
            extra = _tangent(forward, forces, along, taken)
            for k, port in enumerate(forces.ports):
                for column in range(extra.shape[2]):
                    packed.add_port(column, port, extra[:, k, column])
        residual = self.whitener(spectrum, self.part)
        return Linearisation(residual, packed.jacobian, spectrum, forward, forces, motions)

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
    ) -> ComplexArray:
        """Sensitivity to one parameter of a term by a finite difference of the whole model, (F, S)."""
        term = point.terms[index]
        step = _step_of(term, parameter)
        moved = term.moved(parameter, step)
        terms = tuple(moved if k == index else t for k, t in enumerate(point.terms))
        other, other_forward, _ = self.predict(replace(point, terms=terms), _start(forces))
        free = other_forward.free_rows() - forward.free_rows()
        return (other - shown + self.part.grid.forward(free @ point.state)) / step

    def smooth(self, point: Point, last: Linearisation | None = None) -> Point:
        """Smooth the inputs at a point near the last one: what of the residual their noise explains is taken for it.

        Returns the point, where the system has measured forces with its starting state fitted anew.
        """
        if len(self.noise.force):
            return self._along_measured_motion(
                point, None if last is None or last.forces is None else last.forces.force
            )
        if last is not None:  # the noise of supports is small: the last residual tells it well enough
            self.smoothed = self._smoothed(last.spectrum)
        return point

    def shown_by_motion(self, fit: Fit) -> ComplexArray:
        """What the sensors show of a fit's smoothed motion, (F, S)."""
        shown = self.part.sensors - fit.spectrum
        if fit.forward.part is self.part:
            return shown
        return shown - self._of_input_noise(fit.forward) * fit.forward.sensor_factor

    def _along_measured_motion(self, point: Point, force: FloatArray | None) -> Point:
        """Smooth measured forces, with laws along the motion that results; `force` (4N, m) is theirs along one nearby.

        A measured force takes the blame for whatever else pushes the body, so its noise is large and the smoothed
        motion is the one that the sensors saw, not a free run.  Smoothing and the laws' forces take turns.
        """
        part = self.part
        forward = Forward(self.system, part, self.sensors, point.theta, point.terms)
        self.whitener = Whitener.of(forward, self.noise)  # the noise goes through the plant as it is now
        free = self._free_columns(forward)
        columns = self.whitener(free, part)
        scale = _scale(columns.T @ columns, columns.shape[1])
        for _ in range(_SMOOTHINGS if any(map(is_waveform, point.terms)) else 1):
            loop = forward.loop(point.state)
            forces = None
            if loop is not None:
                force = loop.law(loop.d0, loop.v0) if force is None else force
                forces = loop.answer(force)
            spectrum = part.sensors - self._shown(forward, forces) - free @ point.state
            residual = self.whitener(spectrum, part)
            if not np.all(np.isfinite(residual)):
                break  # a law gone astray; the residual will tell
            change = scale * np.linalg.lstsq(columns * scale, residual, rcond=1e-9)[0]
            point = replace(point, state=point.state + change)
            self.smoothed = self._smoothed(spectrum - free @ change)
            if force is not None:
                loop = forward.driven_by(self.smoothed).loop(point.state)
                assert loop is not None
                force = loop.law(*loop.motion(force))
        return point

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

    def fit(self, start: Point, iterations: int = 12, tolerance: float = 1e-3) -> Fit:
        """Gauss-Newton with Levenberg damping from `start`; stops when no parameter moves by `tolerance` std."""
        point = self.smooth(_preloaded(self, start))
        lin = self.linearise(point)
        best, kept = _objective(lin.residual, point), (self.whitener, self.smoothed)
        damping, converged, count = 1e-6, False, 0
        for count in range(1, iterations + 1):
            step, sigma = _step(lin.jacobian, lin.residual, point, damping)
            trial = self.smooth(advance(point, step), lin)
            size = float(np.max(np.abs(step[: len(sigma)]) / np.maximum(sigma, 1e-300))) if len(sigma) else 0.0
            proposal = self.linearise(trial, _start(lin.forces))
            value = _objective(proposal.residual, trial)
            if value <= best * (1 + _SLACK) + 0.5:
                gained = best - value
                point, lin, best, kept = trial, proposal, value, (self.whitener, self.smoothed)
                damping = max(damping / 10, 1e-9)
                if size < tolerance or gained < 0.02 * max(1.0, size):
                    converged = True
                    break
                if count in (2, 4):
                    point = _preloaded(self, point)
            else:
                damping = max(damping * 30, 1e-4)
                if damping > 1e3:
                    break
        self.whitener, self.smoothed = kept
        return _finish(self, point, lin, converged, count)


class Columns:
    """The jacobian, column by column in whitened real numbers, stored so that every column is contiguous."""

    def __init__(self, problem: Problem, forward: Forward, count: int) -> None:
        assert problem.whitener is not None
        grid = problem.part.grid
        band = grid.band
        self.band, self.forward, self.problem = band, forward, problem
        weighted = problem.whitener.factor * grid.weight[:, None, None]
        shown = forward.sensor_factor[band, :, None]
        self.of_shown = weighted
        along = weighted @ (forward.plant.sensor_of_force[band] * shown)
        self.of_force = np.ascontiguousarray(along.transpose(2, 0, 1))
        size = weighted.shape[0] * weighted.shape[1]
        self.half = size
        self.store = np.zeros((count, 2 * size))

    @property
    def jacobian(self) -> FloatArray:
        """(2 F S, columns)."""
        return self.store.T

    @property
    def whitened(self) -> ComplexArray:
        """All columns as whitened spectra, (F, S, columns)."""
        weight = self.problem.part.grid.weight[:, None, None]
        shape = (self.band.stop, -1, len(self.store))
        spectra = (self.store[:, : self.half] + 1j * self.store[:, self.half :]).T.reshape(shape) / weight
        return np.asarray(spectra, dtype=complex)

    def _add(self, column: int, whitened: ComplexArray) -> None:
        self.store[column, : self.half] += whitened.real.ravel()
        self.store[column, self.half :] += whitened.imag.ravel()

    def add_force(self, column: int, element: int, force: ComplexArray) -> None:
        """Response to a force along an element, (F,)."""
        plant = self.forward.plant
        if plant.floats:
            rest, line = plant.without_line(force[:, None])
            motion = np.einsum("k,kpn->pn", line[:, 0], plant.line_motion(np.eye(len(plant.structure.H))[element]))
            self._add_polynomial(column, motion)
            force = rest[:, 0]
        self._add(column, self.of_force[element] * force[self.band, None])

    def _add_polynomial(self, column: int, motion: FloatArray) -> None:
        """What the sensors show of a polynomial motion."""
        plant = self.forward.plant
        still = np.zeros((motion.shape[0], plant.structure.G.shape[1]))
        seen = plant.grid.monomial_spectra @ plant.polynomial_sensors(motion, still)
        self.add_shown(column, seen * self.forward.sensor_factor)

    def add_port(self, column: int, port: FloatArray, force: ComplexArray) -> None:
        """Response to a force along a port."""
        for element in np.flatnonzero(port):
            self.add_force(column, int(element), port[element] * force)

    def add_load(self, column: int, load: ComplexArray) -> None:
        """Response to loads on the degrees of freedom, (F, n)."""
        plant, band = self.forward.plant, self.band
        if plant.floats:
            load, line = plant.without_line(load)
            self._add_polynomial(column, plant.polynomial_response(_line_load(line)))
        shown = np.einsum("fsn,fn->fs", plant.sensor_of_load[band], load[band]) * self.forward.sensor_factor[band]
        self._add(column, (self.of_shown @ shown[:, :, None])[:, :, 0])

    def add_shown(self, column: int, shown: ComplexArray) -> None:
        """A change of the shown signals, (F, S)."""
        self._add(column, (self.of_shown @ shown[self.band][:, :, None])[:, :, 0])

    def add_free(self, first: int, free: ComplexArray) -> None:
        """Free motions, (F, S, 2n)."""
        whitened = np.ascontiguousarray((self.of_shown @ free[self.band]).transpose(2, 0, 1))
        for i, column in enumerate(whitened):
            self._add(first + i, column)


class Taken:
    """What of a motion along the laws' ports the smoothed inputs take back.

    Inputs are smoothed anew when a value moves, so that the motion moves only as far as sensors and inputs allow: where
    a force's noise is large, not at all.
    """

    def __init__(self, problem: Problem, forward: Forward, forces: LawForces) -> None:
        assert problem.whitener is not None
        plant, self.grid = forward.plant, forward.part.grid
        band = self.grid.band
        ports = np.array([_wide(forward, w) for w in forces.ports])
        inputs = np.concatenate([plant.deflection_of_support, plant.deflection_of_measured_force], axis=2)[band]
        self.deflection = ports @ inputs @ problem.whitener.blame  # of whitened sensor signals, (F, m, S)
        self.rate = 1j * self.grid.omega[band, None, None] * self.deflection
        if plant.floats:
            steady = ports @ plant.structure.H @ plant.steady_rate @ plant.structure.F
            self.rate[0] = steady @ problem.whitener.blame[0, plant.structure.G.shape[1] :]
        shown = plant.sensor_of_force[band] * forward.sensor_factor[band, :, None]
        self.seen = problem.whitener.factor @ shown @ ports.T  # whitened sensor signals per force along the ports

    def motion(self, whitened: ComplexArray) -> FloatArray:
        """Deflection and rate along the ports taken back of whitened sensor signals (F, S, c), (2, N, m, c)."""
        result = np.empty((2, self.grid.samples, self.deflection.shape[1], whitened.shape[2]))
        for k, rows in enumerate((self.deflection, self.rate)):
            spectra = np.zeros((len(self.grid.omega), *result.shape[2:]), dtype=complex)
            spectra[self.grid.band] = rows @ whitened
            result[k] = self.grid.inverse(spectra)
        return result


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


def _step_of(term: Term, parameter: int) -> float:
    """Step of a finite difference in a term's internal parameter."""
    if term.law.parameters[parameter].log:
        return _RELATIVE_STEP
    return _RELATIVE_STEP * max(abs(term.parameters[parameter]), term.scales[parameter])


def _law_change(forward: Forward, forces: LawForces, term: Term, parameter: int) -> tuple[int, ComplexArray]:
    """Port of a law and the spectrum of its force's derivative along the present trajectory, (F,)."""
    port = next(k for k, t in enumerate(forces.terms) if t.key == term.key)
    if isinstance(term.law, StaticLaw):
        values = term.law.values(forces.deflection[:, port], forces.rate[:, port])
        return port, forward.part.grid.coarse_spectrum(values[parameter])
    step = _step_of(term, parameter)
    change = (_force(forward, term.moved(parameter, step), forces) - _force(forward, term, forces)) / step
    return port, forward.part.grid.coarse_spectrum(change)


def _wide(forward: Forward, port: FloatArray) -> FloatArray:
    """A port's weights over the plant's elements, which may be more than the system's."""
    return np.pad(port, (0, len(forward.plant.structure.H) - len(port)))


def _port_motions(
    forward: Forward,
    forces: LawForces,
    theta_forces: ComplexArray,
    theta_loads: dict[int, ComplexArray],
    law_forces: ComplexArray,
    states: int,
) -> FloatArray:
    """Deflection and rate along the laws' ports per unit of every free value, (2, N, m, columns)."""
    plant, grid = forward.plant, forward.part.grid
    structure = plant.structure
    ports = np.array([_wide(forward, w) for w in forces.ports])
    P, p = theta_forces.shape[1], law_forces.shape[1]
    spectra = np.zeros((len(grid.omega), len(ports), P + p), dtype=complex)
    of_force = ports @ plant.deflection_of_force  # (F, m, E)
    for i, parameter in enumerate(forward.system.parameters):
        if i in theta_loads:
            spectra[:, :, i] = np.einsum("fmn,fn->fm", ports @ plant.deflection_of_load, theta_loads[i])
        else:
            e = forward.system.elements.index(parameter.element)
            spectra[:, :, i] = of_force[:, :, e] * theta_forces[:, i, None]
    spectra[:, :, P:] = (of_force @ ports.T) @ law_forces.transpose(0, 2, 1)
    free = plant.free_motion(structure.motion_rows(ports), grid.step, grid.samples).reshape(
        grid.samples, 2, len(ports), states
    )
    result = np.empty((2, grid.samples, len(ports), P + p + states))
    result[0, :, :, : P + p] = grid.inverse(spectra)
    result[1, :, :, : P + p] = grid.inverse(1j * grid.omega[:, None, None] * spectra)
    result[:, :, :, P + p :] = free.transpose(1, 0, 2, 3)
    if plant.floats:
        for i, parameter in enumerate(forward.system.parameters):
            if i in theta_loads:
                rest, line = plant.without_line(theta_loads[i])
                steady = plant.polynomial_response(_line_load(line)) @ (ports @ structure.H).T
                swinging = np.einsum("fmn,fn->fm", ports @ plant.deflection_of_load, rest)
                result[0, :, :, i] = grid.inverse(swinging) + grid.monomials @ steady
                rate = 1j * grid.omega[:, None] * swinging
                result[1, :, :, i] = grid.inverse(rate) + grid.monomials @ plant.derivative(steady)
            else:
                unit = np.eye(len(structure.H))[forward.system.elements.index(parameter.element)]
                result[:, :, :, i] = _floating(forward, unit[None], ports, theta_forces[:, i, None, None])[..., 0]
        for j in range(p):
            result[:, :, :, P + j] = _floating(forward, ports, ports, law_forces[:, j, :, None])[..., 0]
    return result


def _line_load(line: FloatArray) -> FloatArray:
    """Polynomial loads (DEGREE + 1, n) from their constants and slopes (2, n)."""
    load = np.zeros((DEGREE + 1, line.shape[1]))
    load[:2] = line
    return load


def _floating(forward: Forward, sources: FloatArray, ports: FloatArray, force: ComplexArray) -> FloatArray:
    """Motion along ports (m, E) of a floating system under forces (F, s, columns) along sources (s, E).

    (2, N, m, columns): the mean of a force and the line that joins its ends act through polynomials.
    """
    plant, grid = forward.plant, forward.part.grid
    H = plant.structure.H
    shape = (len(grid.omega), len(sources), -1)
    rest, line = plant.without_line(force.reshape(len(grid.omega), -1))
    line = line.reshape(2, len(sources), -1)
    answer = (ports @ plant.deflection_of_force @ sources.T) @ rest.reshape(shape)
    lines = np.array([plant.line_motion(w) for w in sources])  # (s, 2, DEGREE + 1, n)
    polynomial = np.einsum("skpn,mn,ksc->pmc", lines, ports @ H, line)
    steady = np.stack([polynomial, plant.derivative(polynomial)])
    swinging = np.stack([grid.inverse(answer), grid.inverse(1j * grid.omega[:, None, None] * answer)])
    return swinging + np.einsum("tp,kpmc->ktmc", grid.monomials, steady)


def _tangent(forward: Forward, forces: LawForces, motions: FloatArray, taken: Taken | None) -> ComplexArray:
    """Spectra (F, m, columns) of the forces by which the laws answer small motions along their ports.

    The law's tangent along the trajectory, less the preload that the plant carries, closed over the plant:
    f = s (d0 + D f) with the slopes s over time, solved for all columns at once.  Laws with memory have no tangent
    in one instant; for them the preload stands.
    """
    plant, grid = forward.plant, forward.part.grid
    slopes = np.stack([_slopes(forward, forces, i) for i in range(len(forces.terms))], axis=2)  # (2, N, m)
    ports = np.array([_wide(forward, w) for w in forces.ports])
    compliance = ports @ plant.deflection_of_force @ ports.T  # (F, m, m)
    if taken is not None:
        compliance[grid.band] -= taken.deflection @ taken.seen
    jw = 1j * grid.omega[:, None, None]
    along_d, along_v = slopes[0, :, :, None], slopes[1, :, :, None]

    def close(force: FloatArray) -> FloatArray:
        if plant.floats:
            spectrum = grid.forward(force)
            d, v = _floating(forward, ports, ports, spectrum)
            if taken is not None:
                d, v = (d, v) - taken.motion(taken.seen @ spectrum[grid.band])
            return force - along_d * d - along_v * v
        moved = compliance @ grid.forward(force)
        return force - along_d * grid.inverse(moved) - along_v * grid.inverse(jw * moved)

    return grid.forward(_gmres(close, along_d * motions[0] + along_v * motions[1]))


def _gmres(apply: Callable[[FloatArray], FloatArray], right: FloatArray) -> FloatArray:
    """x with apply(x) = right, one Krylov space per last-axis column, all at once (Saad and Schultz 1986)."""
    size = np.sqrt(np.sum(right**2, axis=(0, 1)))
    used = size > 0
    if not used.any():
        return right
    scale = np.where(used, size, 1.0)
    basis = [right / scale]
    columns = len(scale)
    hessenberg = np.zeros((columns, _KRYLOV + 1, _KRYLOV))
    target = np.zeros((columns, _KRYLOV + 1, 1))
    target[:, 0, 0] = size
    for k in range(_KRYLOV):
        w = apply(basis[k])
        for j, v in enumerate(basis):
            h = np.einsum("nmc,nmc->c", w, v)
            hessenberg[:, j, k] = h
            w = w - h * v
        length = np.sqrt(np.sum(w**2, axis=(0, 1)))
        hessenberg[:, k + 1, k] = length
        solved = np.linalg.pinv(hessenberg[:, : k + 2, : k + 1]) @ target[:, : k + 2]
        left = target[:, : k + 2] - hessenberg[:, : k + 2, : k + 1] @ solved
        if np.max(np.linalg.norm(left[:, :, 0], axis=1)[used] / size[used]) < _KRYLOV_TOLERANCE:
            break
        basis.append(w / np.where(length > 1e-12, length, 1.0))
    result = np.zeros_like(right)
    for j in range(solved.shape[1]):
        result += basis[j] * solved[:, j, 0]
    return result


def _slopes(forward: Forward, forces: LawForces, i: int) -> FloatArray:
    """Derivatives of a law's force by deflection and rate along the trajectory, less the preload, (2, N)."""
    term = forces.terms[i]
    grid = forward.part.grid
    law = term.law
    assert isinstance(law, ElementLaw)
    if law.memory:
        return np.zeros((2, grid.samples))
    d, v = forces.deflection[:, i], forces.rate[:, i]
    time = grid.start + grid.fine_time
    element = forward.element_of(term)
    result = np.empty((2, grid.samples))
    for k, (signal, load) in enumerate(((d, term.preload[0]), (v, term.preload[1]))):
        step = 1e-3 * float(np.std(signal)) + 1e-300
        moves = ((step, 0.0), (-step, 0.0)) if k == 0 else ((0.0, step), (0.0, -step))
        up, down = (force_along(law, term.parameters, d + a, v + b, time, element) for a, b in moves)
        slope = ((up - down) / (2 * step)).reshape(-1, OVERSAMPLING).mean(axis=1)
        result[k] = slope - load
    return result


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


@dataclass(frozen=True)
class Motions:
    """Whole motion of a part as spectra: rates are transformed on their own, since a record's ends do not meet."""

    deflection: ComplexArray  # (F, elements)
    rate: ComplexArray  # (F, elements)
    acceleration: ComplexArray  # of the degrees of freedom, (F, n)


def _motions(forward: Forward, forces: LawForces | None, state: FloatArray) -> Motions:
    plant, grid = forward.plant, forward.part.grid
    s = plant.structure
    n = len(s.mass)
    jw = 1j * grid.omega[:, None]
    q_poly, d_poly = forward.polynomial
    periodic = forward.linear_deflection
    if forces is not None:
        periodic = periodic + forces.deflections
        q_poly, d_poly = q_poly + forces.motion, d_poly + forces.motion @ s.H.T
    A = s.state_matrix()
    free = propagate(A, np.eye(len(A)), state, grid.step, grid.samples)
    d = periodic + grid.monomial_spectra @ d_poly + grid.forward(free[:, :n] @ s.H.T)
    v = jw * periodic + grid.monomial_spectra @ plant.derivative(d_poly) + grid.forward(free[:, n : 2 * n] @ s.H.T)
    q = _periodic_motion(forward, forces)
    bend = plant.derivative(plant.derivative(q_poly))
    acceleration = jw**2 * q + grid.monomial_spectra @ bend + grid.forward(free @ A[n : 2 * n].T)
    return Motions(d[:, : forward.elements], v[:, : forward.elements], acceleration)


def _periodic_motion(forward: Forward, forces: LawForces | None) -> ComplexArray:
    """Periodic part of the degrees of freedom, (F, n)."""
    plant, part = forward.plant, forward.part
    s = plant.structure
    load = -((part.support @ s.G.T) * plant.impedance) @ s.H
    load = load + forward.force @ s.F.T
    q = np.einsum("fnm,fm->fn", plant.receptance, load)
    return q if forces is None else q + forces.q


def _particular_start(forward: Forward, forces: LawForces | None) -> FloatArray:
    """State of the particular solution at the first sample; with the free state it is the true state, (2n + b,)."""
    plant, grid = forward.plant, forward.part.grid
    q = _periodic_motion(forward, forces)
    polynomial = forward.polynomial[0] + (0.0 if forces is None else forces.motion)
    position = grid.inverse(q)[0] + polynomial[0]
    rate = grid.inverse(1j * grid.omega[:, None] * q)[0] + plant.derivative(polynomial)[0]
    deflections = forward.linear_deflection + (0.0 if forces is None else forces.deflections)
    branches = grid.inverse(plant.structure.branch_forces(deflections, grid.omega))[0]
    return np.concatenate([position, rate, branches])


def _preloaded(problem: Problem, point: Point) -> Point:
    """The point with the laws' equivalent stiffness and damping moved into the plant.

    The equivalent depends on the motion that the law shapes, so the two are iterated until the loop converges.
    """
    for _ in range(_PRELOADS):
        if not any(is_waveform(t) and "|" not in t.location for t in point.terms):
            return point
        forward = problem.forward(point)
        forces = forward.law_forces(point.state)
        assert forces is not None
        start = _particular_start(forward, forces)
        terms, change = [], 0.0
        for term in point.terms:
            if is_waveform(term) and "|" not in term.location:
                k, c = _equivalent(forward, forces, term)
                element = forward.element_of(term)
                size = abs(float(element.stiffness)) + 1e-12, abs(float(element.damping)) + 1e-12
                change = max(
                    change,
                    abs(k - term.preload[0]) / (size[0] + abs(k)),
                    abs(c - term.preload[1]) / (size[1] + abs(c)),
                )
                terms.append(replace(term, preload=(k, c)))
            else:
                terms.append(term)
        point = replace(point, terms=tuple(terms))
        if change < 1e-3:
            break
        # the free state counts from the plant's particular solution, which has changed: keep the true state
        state = start + point.state
        for _ in range(2):
            moved = problem.forward(point)
            point = replace(point, state=state - _particular_start(moved, moved.law_forces(point.state)))
        if forces.converged and change < 0.2:
            break
    return point


def _equivalent(forward: Forward, forces: LawForces, term: Term) -> tuple[float, float]:
    """Stiffness and damping that are nearest to a law along its motion."""
    i = next(k for k, t in enumerate(forces.terms) if t.key == term.key)
    thin = slice(None, None, OVERSAMPLING)
    regressors = np.column_stack([forces.deflection[thin, i], forces.rate[thin, i]])
    sizes = np.maximum(np.std(regressors, axis=0), 1e-300)
    reach = 4.0 * sizes
    f = _force(forward, term, forces)[thin]
    inside = np.all(np.abs(regressors) < reach, axis=1)
    k, c = np.linalg.lstsq(regressors[inside] / sizes, f[inside], rcond=None)[0] / sizes
    element = forward.element_of(term)
    k = max(k, -0.9 * element.stiffness) if element.stiffness else 0.0  # a body that floats stays afloat
    c = max(c, -0.9 * element.damping) if element.damping else max(c, 0.0)
    if not forces.converged:
        k, c = (k + term.preload[0]) / 2, (c + term.preload[1]) / 2
    return float(k), float(c)


def _start(forces: LawForces | None) -> tuple[FloatArray, ...]:
    return () if forces is None else tuple(forces.force.T)


def _objective(residual: FloatArray, point: Point) -> float:
    return float(residual @ residual + np.sum((point.theta / PRIOR) ** 2))


def _step(jacobian: FloatArray, residual: FloatArray, point: Point, damping: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step and the standard deviations of theta and term parameters."""
    P = len(point.theta)
    normal = jacobian.T @ jacobian
    gradient = jacobian.T @ residual
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


def advance(point: Point, step: FloatArray) -> Point:
    P = len(point.theta)
    theta = point.theta + np.clip(step[:P], -1.0, 1.0)
    at, terms = P, []
    for term in point.terms:
        count = len(term.parameters)
        terms.append(term.advanced(step[at : at + count]))
        at += count
    return Point(theta, tuple(terms), point.state + step[at:], point.near)


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
