"""What every free value does to the residual: the jacobian of a fit, laws' answers included."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sprung.model.diagnosis.fit.columns import Columns
from sprung.model.diagnosis.fit.tangent import Taken, law_change, port_motions, step_of, tangent
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.spectra import OVERSAMPLING, ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces, near_of
from sprung.model.diagnosis.response.motion import Motions, motions_of
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import is_waveform
from sprung.model.signals import FloatArray

if TYPE_CHECKING:
    from sprung.model.diagnosis.fit.problem import Problem


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


def linearise(problem: Problem, point: Point) -> Linearisation:
    """Residual and sensitivities at a point."""
    shown, forward, forces = problem.predict(point)
    grid = problem.part.grid
    if problem.whitener is None:
        problem.whitener = Whitener.of(forward, problem.noise)
    free = problem.free_columns(forward)
    spectrum = problem.part.sensors - shown - free @ point.state
    motions = motions_of(forward, forces, point.state)
    P = len(point.theta)
    count = P + sum(len(t.parameters) for t in point.terms)
    theta_forces, theta_loads = _theta_forces(problem, forward, motions)
    law_forces = np.zeros((len(grid.omega), count - P, 0 if forces is None else len(forces.terms)), dtype=complex)
    packed = Columns(problem, forward, count + free.shape[2])
    for i, parameter in enumerate(problem.system.parameters):
        if parameter.quantity == "mass":
            packed.add_load(i, theta_loads[i])
        else:
            packed.add_force(i, problem.system.elements.index(parameter.element), theta_forces[:, i])
    at, loads = P, dict(theta_loads)
    slopes = np.zeros(count)
    shifts: dict[int, FloatArray] = {}
    if problem.follows:
        slopes[:P] = _log_det_slopes(problem, forward)
    for index, term in enumerate(point.terms):
        for j in range(len(term.parameters)):
            if forward.faulty_force(term) is not None:
                loads[at] = forward.driven_by(problem.part).fault_load(term)
                packed.add_load(at, loads[at])
            elif is_waveform(term):
                assert forces is not None
                port, change = law_change(forward, forces, term, j)
                law_forces[:, at - P, port] = change
                packed.add_port(at, forces.ports[port], change)
            else:
                effect = _difference(problem, point, index, j, forward, forces, shown)
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
        taken = Taken(problem, forward, forces) if problem.follows else None
        if taken is not None:
            along = along - taken.motion(packed.whitened)
        extra = tangent(forward, forces, along, taken)
        for k, port in enumerate(forces.ports):
            for column in range(extra.shape[2]):
                packed.add_port(column, port, extra[:, k, column])
    residual = problem.whitener(spectrum, problem.part)
    return Linearisation(
        residual, packed.jacobian, problem.whitener.log_det, slopes, spectrum, forward, forces, motions
    )


def _theta_forces(problem: Problem, forward: Forward, motions: Motions) -> tuple[ComplexArray, dict[int, ComplexArray]]:
    """Forces along the own element that act like a rise of log k (log c): (F, P); loads (F, n) of log masses."""
    omega, structure = forward.plant.grid.omega, forward.plant.structure
    forces = np.zeros((len(omega), len(problem.system.parameters)), dtype=complex)
    loads = {}
    for i, parameter in enumerate(problem.system.parameters):
        if parameter.quantity == "mass":
            dofs = structure.body_of_dof == problem.system.bodies.index(parameter.element)
            loads[i] = np.where(dofs, -structure.mass * motions.acceleration, 0.0)
            continue
        value = parameter.nominal * np.exp(forward.theta[i])
        element = problem.system.elements.index(parameter.element)
        along = motions.rate if parameter.quantity == "damping" else motions.deflection
        forces[:, i] = value * along[:, element]
        for branch in structure.branches if parameter.quantity == "damping" else ():
            if branch.element == element and branch.replaces:  # c s / (1 + s c / ks) by log c
                forces[:, i] /= (1 + 1j * omega * branch.time) ** 2
    return forces, loads


def _difference(
    problem: Problem,
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
    other, other_forward, other_forces = problem.predict(replace(point, terms=terms, near=near_of(forces)))
    free = other_forward.free_rows() - forward.free_rows()
    change = (other - shown + problem.part.grid.forward(free @ point.state)) / step
    if not problem.follows:
        return Change(change)
    assert problem.whitener is not None
    log_det = (Whitener.of(other_forward, problem.noise).log_det - problem.whitener.log_det) / step
    if forces is None or other_forces is None:
        return Change(change, log_det)
    thin = slice(None, None, OVERSAMPLING)
    motion = [other_forces.deflection - forces.deflection, other_forces.rate - forces.rate]
    return Change(change, log_det, np.stack(motion)[:, thin] / step)


def _log_det_slopes(problem: Problem, forward: Forward) -> FloatArray:
    """Rise of the residual's log determinant with every log-ratio, (P,): inputs' noise goes through the plant."""
    assert problem.whitener is not None
    plant, band = forward.plant, problem.part.grid.band
    jw = 1j * plant.grid.omega[band, None]
    shown = forward.sensor_factor[band, :, None]
    deflection = plant.deflection_of_inputs[band]
    slopes = np.zeros(len(problem.system.parameters))
    for i, parameter in enumerate(problem.system.parameters):
        value = parameter.nominal * np.exp(forward.theta[i])
        if parameter.quantity == "mass":
            dofs = plant.structure.body_of_dof == problem.system.bodies.index(parameter.element)
            change = forward.inputs_by_mass(dofs)[band]
        else:
            element = problem.system.elements.index(parameter.element)
            factor = value * (jw if parameter.quantity == "damping" else 1.0)
            along = plant.sensor_of_force[band][:, :, element, None] * (factor * deflection[:, element])[:, None]
            change = along * shown
        slopes[i] = problem.whitener.log_det_slope(change)
    return slopes
