"""The forward model: sensor signals of the nominal structure with terms, driven by the measured inputs.

The linear part is mapped bin by bin, the forces of laws along the trajectory are found by harmonic balance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy.fft import irfft
from scipy.linalg import expm

from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray, derivative, detrend_ends
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.harmonic_balance import TOLERANCE, HarmonicBalance, LawForces, fixed_point
from sprung.model.diagnosis.response.newton import PATIENCE, newton_step
from sprung.model.diagnosis.response.structure import Structure
from sprung.model.diagnosis.response.terms import Term, branches_of, evaluated_in_time, supports
from sprung.model.laws import CLOCK_LEAD, SensorLaw, SensorResponse, SpringDamper, SupportLaw
from sprung.model.laws.channel import FilterSection
from sprung.model.laws.in_place import with_law
from sprung.model.mechanics import VELOCITY, Mechanics
from sprung.model.ratios import mechanics_at
from sprung.model.signals import FloatArray
from sprung.model.system import System


def mechanics_of(system: System, theta: FloatArray, terms: tuple[Term, ...] = ()) -> Mechanics:
    """Mechanics for log-ratios `theta` (P,) of the system's parameters, with laws of bodies and structure."""
    mechanics = mechanics_at(system, theta)
    for term in terms:
        if term.law.load is None:  # else its force is added to the response
            mechanics = with_law(system.file, mechanics, term.law, term.location, term.parameters, term.variant)
    return mechanics


def structure_of(system: System, sensors: np.ndarray, theta: FloatArray, terms: tuple[Term, ...] = ()) -> Structure:
    """The same with the sensors `sensors` (S,)."""
    return Structure.nominal(mechanics_of(system, theta, terms), sensors)


@dataclass(frozen=True)
class Forward:
    """One model on one part of a recording."""

    system: System
    part: Part
    sensors: np.ndarray  # indices of the present sensors, (S,)
    theta: FloatArray  # (P,)
    terms: tuple[Term, ...] = ()
    warm_start: tuple[FloatArray, ...] = ()  # laws' forces of a nearby solution, each (4N,)
    known: Plant | None = None  # of a nearby model, reused if the structure is equal
    newton_allowed: bool = True  # whether Newton's method is tried where the balance does not converge

    @cached_property
    def plant(self) -> Plant:
        structure = structure_of(self.system, self.sensors, self.theta, self.terms)
        structure = replace(structure, sensor_kind=np.where(self.part.differentiated, VELOCITY, structure.sensor_kind))
        stiffness, damping = structure.stiffness.copy(), structure.damping.copy()
        for term in filter(evaluated_in_time, self.terms):
            if "|" not in term.location:
                e = self.system.elements.index(term.location)
                stiffness[e] += term.equivalent[0]
                damping[e] += term.equivalent[1]
        branches = tuple(branch for term in self.terms for branch in branches_of(term, self.system, structure))
        structure = replace(structure, stiffness=stiffness, damping=damping, branches=branches)
        if self.known is not None and self.known.grid == self.part.grid and self.known.structure.same(structure):
            return self.known if self.known.structure.filters == self.filters else self.known.behind(self.filters)
        return Plant(replace(structure, filters=self.filters), self.part.grid)

    def element_of(self, term: Term) -> SpringDamper:
        """Spring and damper of the element a term acts at, with the parameters of this model."""
        return self.element_at(term.location)

    def element_at(self, location: str) -> SpringDamper:
        """Spring and damper of an element, or of the first of a pair, with the parameters of this model."""
        structure = structure_of(self.system, self.sensors, self.theta)
        e = self.system.elements.index(location.partition("|")[0])
        return SpringDamper(structure.stiffness[e], structure.damping[e])

    @property
    def elements(self) -> int:
        return len(self.system.elements)

    @cached_property
    def polynomial(self) -> tuple[FloatArray, FloatArray]:
        """Polynomial motion (DEGREE + 1, n) and deflections (DEGREE + 1, E) under the polynomial inputs."""
        plant, s = self.plant, self.plant.structure
        support = self.support_polynomial
        moved = support @ s.G.T
        load = -(moved * s.stiffness + plant.derivative(moved) * s.steady_damping) @ s.H
        load = load + self.force_polynomial @ s.F.T
        q = plant.polynomial_response(load)
        return q, q @ s.H.T + moved

    @cached_property
    def linear_sensors(self) -> ComplexArray:
        """True signals without laws' forces and free motion, (F, S)."""
        return self.plant.sensors(self.support, self.force)

    @cached_property
    def _unmeasured(self) -> tuple[ComplexArray, FloatArray]:
        """Motion of the supports beside the measured one: (F, supports) and (DEGREE + 1, supports)."""
        grid = self.part.grid
        spectrum = np.zeros(self.part.support.shape, dtype=complex)
        polynomial = np.zeros(self.part.support_polynomial.shape)
        time = grid.start + grid.time + CLOCK_LEAD
        names = supports(self.system)
        for term in self.terms:
            if isinstance(term.law, SupportLaw):
                at = [names.index(name) for name in term.location.split("|")]
                d, v = (x[:, None] for x in term.law.movement(time, term.parameters, grid.nyquist))
                line = detrend_ends(d, (v[0], v[-1]), grid)
                spectrum[:, at] += grid.forward(d - grid.monomials @ line)
                polynomial[:, at] += line
        return spectrum, polynomial

    @cached_property
    def support(self) -> ComplexArray:
        """Displacement of the supports, m, periodic part, (F, supports)."""
        return self.part.support / self.support_gain + self._unmeasured[0]

    @property
    def support_polynomial(self) -> FloatArray:
        """The same, polynomial part, (DEGREE + 1, supports)."""
        return self.part.support_polynomial / self.support_gain + self._unmeasured[1]

    @cached_property
    def support_gain(self) -> FloatArray:
        """Gain of every support's measured motion, (supports,)."""
        names = supports(self.system)
        gain = np.ones(len(names))
        for term in self.terms:
            name, _, quantity = term.location.partition(".")
            response = response_of(term)
            if response is not None and quantity and name in names:
                gain[names.index(name)] *= response.gain
        return gain

    @cached_property
    def force_faults(self) -> tuple[FloatArray, FloatArray]:
        """Gain and offset of every measured force, each (forces,)."""
        count = self.part.force.shape[1]
        gain, offset = np.ones(count), np.zeros(count)
        for term in self.terms:
            i, response = self.faulty_force(term), response_of(term)
            if i is not None and response is not None:
                gain[i] *= response.gain
                offset[i] += response.offset
        return gain, offset

    def faulty_force(self, term: Term) -> int | None:
        """Index of the measured force that a term is a fault of; None for other terms."""
        names = [n for n, source in self.system.file.inputs.items() if source.kind == "force"]
        return names.index(term.location) if isinstance(term.law, SensorLaw) and term.location in names else None

    def fault_load(self, term: Term) -> ComplexArray:
        """Derivative of the load on the degrees of freedom by the first parameter of a force's fault, (F, n)."""
        i, law = self.faulty_force(term), term.law
        if i is None or not isinstance(law, SensorLaw):
            raise TypeError(f"{law.name} at {term.location} is no fault of a measured force")
        gain, slope = self.force_faults[0][i], law.slope()
        change = -slope.gain * (self.force + self.part.grid.monomial_spectra @ self.force_polynomial)[:, i] / gain
        change[0] -= slope.offset * np.sqrt(self.part.grid.samples) / gain
        found: ComplexArray = change[:, None] * self.plant.structure.F[:, i]
        return found

    def inputs_by_force_fault(self, term: Term) -> ComplexArray:
        """Derivative of `of_inputs` by the first parameter of a force's fault, (F, S, inputs)."""
        i, law = self.faulty_force(term), term.law
        if i is None or not isinstance(law, SensorLaw):
            raise TypeError(f"{law.name} at {term.location} is no fault of a measured force")
        at = len(self.support_gain) + i
        change = np.zeros_like(self.of_inputs)
        change[:, :, at] = -law.slope().gain * self.of_inputs[:, :, at] / self.force_faults[0][i]
        return change

    @property
    def of_inputs(self) -> ComplexArray:
        """Shown sensor signals per measured support motion and force, (F, S, inputs)."""
        both = np.concatenate([self.plant.sensor_of_support, self.plant.sensor_of_measured_force], axis=2)
        gains = np.concatenate([self.support_gain, self.force_faults[0]])
        found: ComplexArray = both * self.sensor_factor[:, :, None] / gains
        return found

    def own_mass(self, body: str) -> FloatArray:
        """Mass and inertias of a body at its own degrees of freedom, 0 at the others, (n,)."""
        structure = self.plant.structure
        return np.where(structure.body_of_dof == self.system.bodies.index(body), structure.mass, 0.0)

    def inputs_by_mass(self, body: str) -> ComplexArray:
        """Derivative of `of_inputs` by the log of a body's mass and inertias, (F, S, inputs)."""
        plant = self.plant
        moved = plant.receptance @ plant.load_of_inputs
        inertia = (self.part.grid.omega**2)[:, None, None] * self.own_mass(body)[:, None]
        found: ComplexArray = plant.sensor_of_load @ (inertia * moved) * self.sensor_factor[:, :, None]
        return found

    @property
    def force(self) -> ComplexArray:
        """Measured forces corrected for their faults, periodic part, (F, forces)."""
        return self.part.force / self.force_faults[0]

    @property
    def force_polynomial(self) -> FloatArray:
        """The same, polynomial part, (DEGREE + 1, forces)."""
        gain, offset = self.force_faults
        result = self.part.force_polynomial.copy()
        result[:1] -= offset
        return result / gain

    def shown(self, periodic: ComplexArray, polynomial: FloatArray) -> ComplexArray:
        """Shown signals (F, S) of true ones, periodic (F, S) plus polynomial (DEGREE + 1, S), with sensor faults."""
        grid = self.part.grid
        gain, lag, delay, offset = self.faults
        late = _lagged(_later(polynomial, delay / grid.length), lag / grid.length)
        for i, section in self.filters:
            late[:, i] = _filtered(late[:, i], section, grid.length)
        shown = periodic * self.sensor_factor + grid.monomial_spectra @ (late * gain)
        shown[0] += offset * np.sqrt(grid.samples)
        return shown

    @cached_property
    def faults(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Gain, time constant of a lag (s), pure delay (s) and offset of every present sensor, each (S,)."""
        gain, lag, delay, offset = (np.full(len(self.sensors), value) for value in SensorResponse()[:4])
        for i, response in self._responses:
            gain[i] *= response.gain
            lag[i] += response.lag
            delay[i] += response.delay
            offset[i] += response.offset
        return gain, lag, delay, offset

    @property
    def _responses(self) -> Iterator[tuple[int, SensorResponse]]:
        """Responses of faulty sensors, by their index among those present."""
        names = [self.system.sensors[i] for i in self.sensors]
        for term in self.terms:
            response = response_of(term)
            if response is not None:
                yield from ((names.index(place), response) for place in term.places if place in names)

    @cached_property
    def filters(self) -> tuple[tuple[int, FilterSection], ...]:
        """Filters of the present sensors, by their index."""
        return tuple((i, section) for i, response in self._responses for section in response.sections)

    @cached_property
    def sensor_factor(self) -> ComplexArray:
        """Frequency response of every sensor, shown over true signal, (F, S)."""
        gain, lag, delay, _ = self.faults
        s = 1j * self.part.grid.omega[:, None]
        found: ComplexArray = gain * np.exp(-s * delay) / (1 + s * lag)
        for i, section in self.filters:
            found[:, i] *= section.at(s[:, 0])
        return found

    def of_body_loads(self) -> ComplexArray | float:
        """Sensor signals of the unmeasured forces on bodies, (F, S)."""
        return sum((self.of_body_load(term) for term in self.terms if _loads(term)), 0.0)

    def of_body_load(self, term: Term) -> ComplexArray:
        """Sensor signals of one unmeasured force on a body, (F, S)."""
        grid, law = self.part.grid, term.law
        assert law.load is not None
        spectrum = grid.forward(law.load(grid.start + grid.time + CLOCK_LEAD, term.parameters))
        dof = self.system.mechanics.dofs.index(f"{term.location}.{term.variant}")
        return self.plant.sensor_of_load[:, :, dof] * spectrum[:, None] * self.sensor_factor

    @cached_property
    def linear_motion(self) -> ComplexArray:
        """Periodic part of the degrees of freedom without laws' forces and free motion, (F, n)."""
        load = self.plant.load(self.support, self.force)
        found: ComplexArray = np.einsum("fnm,fm->fn", self.plant.receptance, load)
        return found

    @cached_property
    def linear_deflection(self) -> ComplexArray:
        """Periodic part of the deflections without laws' forces and free motion, (F, E)."""
        s = self.plant.structure
        return self.linear_motion @ s.H.T + self.support @ s.G.T

    def free_rows(self) -> FloatArray:
        """Shown signals of the free motion per state at the first sample, (N, S, 2n)."""
        grid = self.part.grid
        return self.plant.free_motion(self.free_rows_at_start(), grid.step, grid.samples)

    def free_rows_at_start(self) -> FloatArray:
        """Output rows of the sensors at the first sample, with their faults, (S, 2n)."""
        rows = self.plant.structure.sensor_rows()
        gain, lag, delay, _ = self.faults
        A = self.plant.structure.state_matrix()
        for i in np.flatnonzero((lag != 0) | (delay != 0)):
            rows[i] = rows[i] @ expm(-A * delay[i]) @ np.linalg.inv(np.eye(len(A)) + A * lag[i])
        at = self.plant.structure.moving
        moving = slice(at)
        for sensor, section in self.filters:
            rows[sensor, moving] = section.of_matrix(rows[sensor, moving], A[moving, moving])
            rows[sensor, at] = 1.0
            at += section.order
        return rows * gain[:, None]

    def fine_motion(self, ports: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deflection and rate along ports (m, E) without laws' forces on the oversampled axis, each (4N, m)."""
        ports = self.plant.structure.padded(ports)
        rows = self.plant.structure.motion_rows(ports)
        return self.fine_motion_of(self.linear_deflection @ ports.T, self.polynomial[1] @ ports.T, rows, state)

    def fine_motion_of(
        self, deflection: ComplexArray, polynomial: FloatArray, rows: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The same of a periodic deflection (F', m), a polynomial one (DEGREE + 1, m) and the free motion of a state.

        rows: deflections, then rates, per state, (2m, 2n).
        """
        plant, grid, m = self.plant, self.part.grid, len(rows) // 2
        series = np.stack([deflection.T, 1j * grid.omega * deflection.T])  # time last: contiguous transforms
        d, v = (irfft(series, len(grid.fine_time)) * (OVERSAMPLING * np.sqrt(grid.samples))).transpose(0, 2, 1)
        free = propagate(plant.structure.state_matrix(), rows, state, grid.step / OVERSAMPLING, len(d))
        d = d + grid.fine_monomials @ polynomial + free[:, :m]
        return d, v + grid.fine_monomials @ plant.derivative(polynomial) + free[:, m:]

    def law_forces(self, state: FloatArray, tolerance: float = TOLERANCE) -> LawForces | None:
        """Forces of the laws along their own trajectory, to a relative tolerance; None if there are no such laws."""
        balance = self.harmonic_balance(state)
        if balance is None:
            return None
        start = np.column_stack(self.warm_start) if self.warm_start else balance.law_forces(balance.d0, balance.v0)
        force, settled = fixed_point(lambda force: balance.law_forces(*balance.motion(force)), start, tolerance)
        newton = None if settled or not self.newton_allowed or self.plant.floats else newton_step(balance)
        if newton is None:
            return balance.solution(force, settled)
        for begin in (start,) if self.warm_start else (start, np.zeros_like(start)):
            found, settled = fixed_point(newton, begin, tolerance, PATIENCE)
            if settled:
                return balance.solution(found)
        return balance.solution(force, converged=False)

    def harmonic_balance(self, state: FloatArray) -> HarmonicBalance | None:
        """Harmonic balance of the laws that are evaluated in time; None if there are none."""
        waveform = [term for term in self.terms if evaluated_in_time(term)]
        if not waveform:
            return None
        ports = np.array([term.port(self.system) for term in waveform])
        elements = [self.element_of(term) for term in waveform]
        return HarmonicBalance(self.plant, waveform, ports, elements, self.fine_motion(ports, state))

    def with_part(self, part: Part, warm_start: tuple[FloatArray, ...] = ()) -> Forward:
        """The same model under other inputs; warm_start: laws' forces of a nearby solution."""
        other = replace(self, part=part, warm_start=warm_start)
        other.__dict__["plant"] = self.plant
        return other


def response_of(term: Term) -> SensorResponse | None:
    """Response of a faulty channel; None for terms that are not faults of a sensor."""
    return None if term.law.response is None else term.law.response(term.parameters)


def _loads(term: Term) -> bool:
    return term.law.load is not None


def _later(polynomial: FloatArray, delay: FloatArray) -> FloatArray:
    """Coefficients of p(t - delay) from those of p(t), one delay per column."""
    if not np.any(delay):
        return polynomial
    result = np.zeros_like(polynomial)
    for k in range(len(polynomial)):
        for j in range(k + 1):
            result[j] += polynomial[k] * comb(k, j) * (-delay) ** (k - j)
    return result


def _filtered(polynomial: FloatArray, section: FilterSection, length: float) -> FloatArray:
    """Coefficients (DEGREE + 1,) over t / length of a polynomial behind a filter."""
    result, current = np.zeros_like(polynomial), polynomial
    for coefficient in section.expanded(len(polynomial)):
        result = result + coefficient * current
        current = derivative(current, length)
    return result


def _lagged(polynomial: FloatArray, lag: FloatArray) -> FloatArray:
    """Coefficients of p behind a first-order lag, p - lag p' + lag^2 p'' ..., one lag per column."""
    if not np.any(lag):
        return polynomial
    result, derivative = polynomial.copy(), polynomial
    orders = np.arange(1, len(polynomial))[:, None]
    for k in range(1, len(polynomial)):
        following = np.zeros_like(derivative)
        following[:-1] = derivative[1:] * orders
        derivative = following
        result = result + (-lag) ** k * derivative
    return result


def propagate(A: FloatArray, rows: FloatArray, state: FloatArray, step: float, count: int) -> FloatArray:
    """rows (R, N) e^{A t} state (N,) at t = 0, step, ...: (count, R), states by doubling; A (N, N), step in s."""
    power = expm(A * step)
    states = np.empty((count, len(state)))
    states[0] = state
    done = 1
    while done < count:
        more = min(done, count - done)
        states[done : done + more] = states[:more] @ power.T
        power = power @ power
        done += more
    return states @ rows.T
