"""Jacobian of a fit: sensitivities of the residual to all free values, with the reaction of the laws."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.fit.columns import JacobianColumns
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working
from sprung.model.diagnosis.fit.tangent import (
    SmootherCorrection,
    law_change,
    law_change_by_element,
    port_motions,
    step_of,
    tangent,
)
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, warm_start_of
from sprung.model.diagnosis.response.motion import Motions, motions_of
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import evaluated_in_time
from sprung.model.laws import SensorLaw
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Change:
    """Derivatives by one parameter."""

    shown: ComplexArray  # of the shown sensor signals, (F, S)
    log_det: float = 0.0  # of the log determinant of the residual's covariance
    motion: FloatArray | None = None  # of deflection and rate along the laws' ports at constant forces, (2, N, m)


@dataclass(frozen=True)
class Linearised:
    """Residual at a point, with sensitivities computed on demand: rejected steps need none."""

    problem: Problem
    point: Point
    working: Working
    forward: Forward
    forces: LawForces | None
    shown: ComplexArray  # sensor signals without the free motion, (F, S)
    fine: bool = False  # whether the reaction of the laws is that on the oversampled axis

    @cached_property
    def spectrum(self) -> ComplexArray:
        """The residual itself, (F, S)."""
        free = self.problem.free_motion(self.forward, self.point.state)
        found: ComplexArray = self.problem.part.sensors - self.shown - free
        return found

    @cached_property
    def residual(self) -> FloatArray:
        """The residual, whitened, (R,)."""
        return self.working.whitener(self.spectrum, self.problem.part)

    def whitened_after(self, step: FloatArray) -> ComplexArray:
        """The whitened residual that a small step (P + p + 2n,) leaves, (F, S)."""
        return self.problem.part.grid.unpack(self.residual - self.jacobian @ step, len(self.problem.sensors))

    @property
    def log_det(self) -> float:
        """Of the residual's covariance."""
        return self.working.whitener.log_det

    @cached_property
    def motions(self) -> Motions:
        """Total motion under the inputs of the residual."""
        return motions_of(self.forward, self.forces, self.point.state)

    @property
    def may_be_finer(self) -> bool:
        """Whether the reaction of the laws is not that on the oversampled axis yet, and would be better there.

        A rounded corner that a motion passes within a sample, as friction's, has no slope on either axis.
        """
        forces = None if self.problem.process_noise or self.forward.plant.floats else self.forces
        return not self.fine and forces is not None and not any(one.law.rounded for one in forces.terms)

    @property
    def jacobian(self) -> FloatArray:
        """Of the model, whitened, columns theta, term parameters (internal scale), state: (R, P + p + 2n)."""
        return self._sensitivities.packed.jacobian

    @cached_property
    def gram(self) -> FloatArray:
        """Of the jacobian's columns."""
        return np.asarray(self.jacobian.T @ self.jacobian)

    @property
    def log_det_slope(self) -> FloatArray:
        """By theta and term parameters, (P + p,)."""
        return self._sensitivities.log_det

    @cached_property
    def _sensitivities(self) -> _Sensitivities:
        problem, point, working = self.problem, self.point, self.working
        known = _of_theta(problem, self.forward, self.forces, working.whitener, self.motions, point)
        _add_terms(known, problem, point, working, self.forward, self.forces, self.shown, self.motions)
        free = problem.free_columns(self.forward)
        known.packed.add_free(len(known.log_det), free)
        if self.forces is not None:
            whitener, states = working.whitener, free.shape[2]
            _add_laws_answers(known, problem, whitener, self.forward, self.forces, states, fine=self.fine)
        return known


def sensitivities_to_loads(
    problem: Problem, forward: Forward, forces: LawForces, whitener: Whitener, loads: list[ComplexArray]
) -> FloatArray:
    """Whitened responses to loads (F, n) on the degrees of freedom, with the reaction of the laws, (R, loads).

    To the same approximation as the columns of a fit: a load that they can imitate leaves nothing beside them.
    """
    parameters, states = len(forward.system.parameters), forward.plant.structure.states
    bins, last = len(forward.part.grid.omega), parameters + len(loads)
    known = _Sensitivities(
        JacobianColumns(forward, whitener, last + states),
        np.zeros((bins, parameters), dtype=complex),
        dict(enumerate(loads, parameters)),
        np.zeros((bins, last, len(forces.terms)), dtype=complex),
        np.zeros(last),
    )
    for column, load in known.loads.items():
        known.packed.add_load(column, load)
    _add_laws_answers(known, problem, whitener, forward, forces, states)
    return known.packed.jacobian[:, parameters:last]


@dataclass
class _Sensitivities:
    """Sensitivities to theta and the terms' parameters, assembled column by column."""

    packed: JacobianColumns
    theta_forces: ComplexArray  # along the parameters' elements, (F, P)
    loads: dict[int, ComplexArray]  # on the degrees of freedom, (F, n), by column
    law_forces: ComplexArray  # of the laws along the present motion, (F, P + p, m)
    log_det: FloatArray  # (P + p,)
    shifts: dict[int, FloatArray] = field(
        default_factory=dict
    )  # motion along ports, (2, N, m), by column, of terms that move bodies directly


def linearise(problem: Problem, point: Point, working: Working, *, fine: bool = False) -> Linearised:
    """Residual and sensitivities at a point.

    fine: with the reaction of the laws on the oversampled axis (`tangent`).
    """
    if problem.work is not None:
        problem.work.add(problem.part.grid.samples)
    shown, forward, forces = problem.predict(point, working.inputs, working.plant)
    return Linearised(problem, point, working, forward, forces, shown, fine)


def _of_theta(
    problem: Problem, forward: Forward, forces: LawForces | None, whitener: Whitener, motions: Motions, point: Point
) -> _Sensitivities:
    """All columns, of which those of theta are set."""
    P, p = len(point.theta), sum(len(t.parameters) for t in point.terms)
    theta_forces, loads = _theta_forces(forward, motions)
    packed = JacobianColumns(forward, whitener, P + p + len(point.state))
    for i, parameter in enumerate(problem.system.parameters):
        if parameter.quantity == "mass":
            packed.add_load(i, loads[i])
        else:
            packed.add_force(i, problem.system.elements.index(parameter.element), theta_forces[:, i])
    slopes = np.zeros(P + p)
    if problem.process_noise:
        slopes[:P] = _log_det_slopes(forward, whitener)
    laws = 0 if forces is None else len(forces.terms)
    law_forces = np.zeros((len(forward.part.grid.omega), P + p, laws), dtype=complex)
    if forces is not None:
        for i, port, change in law_change_by_element(forward, forces):
            law_forces[:, i, port] = change
            packed.add_port(i, forces.ports[port], change)
    return _Sensitivities(packed, theta_forces, loads, law_forces, slopes)


def _add_terms(
    known: _Sensitivities,
    problem: Problem,
    point: Point,
    working: Working,
    forward: Forward,
    forces: LawForces | None,
    shown: ComplexArray,
    motions: Motions,
) -> None:
    """Columns of the terms' parameters, without the reaction of the laws.

    Another mass gets its column in the same way as an estimated one: what masses, stiffnesses and dampings together
    leave unchanged is not determined, however approximate the reaction of the laws is.
    """
    at = len(point.theta)
    pushed = forward.with_part(problem.driving(forward))
    for index, term in enumerate(point.terms):
        for j in range(len(term.parameters)):
            if forward.faulty_force(term) is not None:
                known.loads[at] = pushed.fault_load(term)
                known.packed.add_load(at, known.loads[at])
                if problem.process_noise:
                    change = forward.inputs_by_force_fault(term)[forward.part.grid.band]
                    known.log_det[at] = working.whitener.log_det_slope(change)
            elif term.law.scales:
                known.loads[at] = inertial_load(forward, motions, term.location)
                known.packed.add_load(at, known.loads[at])
                if problem.process_noise:
                    change = forward.inputs_by_mass(term.location)[forward.part.grid.band]
                    known.log_det[at] = working.whitener.log_det_slope(change)
            elif forces is not None and evaluated_in_time(term):
                port, change = law_change(forward, forces, term, j)
                known.law_forces[:, at, port] = change
                known.packed.add_port(at, forces.ports[port], change)
            else:
                effect = _difference(problem, point, working, (index, j), forward, forces, shown)
                known.packed.add_shown(at, effect.shown)
                known.log_det[at] = effect.log_det
                if effect.motion is not None:
                    known.shifts[at] = effect.motion
            at += 1


def _add_laws_answers(
    known: _Sensitivities,
    problem: Problem,
    whitener: Whitener,
    forward: Forward,
    forces: LawForces,
    states: int,
    *,
    fine: bool = False,
) -> None:
    """Adds the reaction of the laws to the motion of every column."""
    along = port_motions(forward, forces, known.theta_forces, known.loads, known.law_forces, states)
    for column, motion in known.shifts.items():
        along[..., column] = motion
    correction = SmootherCorrection(whitener, forward, forces) if problem.process_noise else None
    if correction is not None:
        along = along - correction.motion(known.packed.whitened)
    extra, evaluations = tangent(forward, forces, along, correction, fine=fine)
    problem.count(evaluations)
    for k, port in enumerate(forces.ports):
        for column in range(extra.shape[2]):
            known.packed.add_port(column, port, extra[:, k, column])


def _theta_forces(forward: Forward, motions: Motions) -> tuple[ComplexArray, dict[int, ComplexArray]]:
    """Forces along an element equivalent to d/d log k (log c), (F, P), and loads (F, n) equivalent to d/d log mass."""
    omega, structure = forward.plant.grid.omega, forward.plant.structure
    forces = np.zeros((len(omega), len(forward.system.parameters)), dtype=complex)
    loads = {}
    for i, parameter in enumerate(forward.system.parameters):
        if parameter.quantity == "mass":
            loads[i] = inertial_load(forward, motions, parameter.element)
            continue
        value = parameter.nominal * np.exp(forward.theta[i])
        element = forward.system.elements.index(parameter.element)
        along = motions.rate if parameter.quantity == "damping" else motions.deflection
        forces[:, i] = value * along[:, element]
        for branch in structure.branches:
            if branch.element == element and parameter.quantity == "damping" and branch.replaces:
                forces[:, i] /= (1 + 1j * omega * branch.time) ** 2  # c s / (1 + s c / ks) by log c
            elif branch.element == element and parameter.quantity == "stiffness" and branch.of_spring:
                forces[:, i] += branch.impedance(omega) * motions.deflection[:, element]
    return forces, loads


def inertial_load(forward: Forward, motions: Motions, body: str) -> ComplexArray:
    """Load (F, n) on the degrees of freedom equivalent to d/d log of a body's mass and inertias."""
    return -forward.own_mass(body) * motions.acceleration


def _difference(
    problem: Problem,
    point: Point,
    working: Working,
    which: tuple[int, int],
    forward: Forward,
    forces: LawForces | None,
    shown: ComplexArray,
) -> Change:
    """Derivatives by a term's parameter (`which`: term, parameter), by a finite difference of the model.

    Forces along a smoothed motion are held constant; their reaction is computed by `tangent`.
    """
    index, parameter = which
    term = point.terms[index]
    step = step_of(term, parameter)
    moved = term.moved(parameter, step)
    terms = tuple(moved if k == index else t for k, t in enumerate(point.terms))
    elsewhere = replace(point, terms=terms, warm_start=warm_start_of(forces))
    of_sensors = isinstance(term.law, SensorLaw) and set(term.places) <= set(problem.system.sensors)
    if of_sensors:  # faults of sensors have no effect on the motion
        other_forward, other_forces = problem.forward(elsewhere, working.inputs, forward.plant), forces
        other = problem.shown(other_forward, forces)
    else:
        other, other_forward, other_forces = problem.predict(elsewhere, working.inputs, forward.plant)
    free = problem.free_motion(other_forward, point.state) - problem.free_motion(forward, point.state)
    if not problem.process_noise:
        return Change((other - shown + free) / step)
    change = (problem.smoothed(other_forward, other) - problem.smoothed(forward, shown) + free) / step
    log_det = (Whitener.of(other_forward, problem.noise).log_det - working.whitener.log_det) / step
    if forces is None or other_forces is None:
        return Change(change, log_det)
    thin = slice(None, None, OVERSAMPLING)
    motion = [other_forces.deflection - forces.deflection, other_forces.rate - forces.rate]
    return Change(change, log_det, np.stack(motion)[:, thin] / step)


def _log_det_slopes(forward: Forward, whitener: Whitener) -> FloatArray:
    """Derivative of the residual's log determinant by the log-ratios, (P,): input noise passes the plant."""
    plant, band = forward.plant, forward.part.grid.band
    jw = 1j * plant.grid.omega[band, None]
    shown = forward.sensor_factor[band, :, None]
    deflection = plant.deflection_of_inputs[band]
    slopes = np.zeros(len(forward.system.parameters))
    for i, parameter in enumerate(forward.system.parameters):
        value = parameter.nominal * np.exp(forward.theta[i])
        if parameter.quantity == "mass":
            change = forward.inputs_by_mass(parameter.element)[band]
        else:
            element = forward.system.elements.index(parameter.element)
            factor = value * (jw if parameter.quantity == "damping" else 1.0)
            if parameter.quantity == "stiffness":
                shares = [b for b in plant.structure.branches if b.element == element and b.of_spring]
                factor = sum((b.impedance(plant.grid.omega[band])[:, None] for b in shares), factor)
            along = plant.sensor_of_force[band][:, :, element, None] * (factor * deflection[:, element])[:, None]
            change = along * shown
        slopes[i] = whitener.log_det_slope(change)
    return slopes
