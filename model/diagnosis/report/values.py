"""Reported values of parameters and laws, with standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.state import InputFault
from sprung.model.diagnosis.report.report import FitFigures, LawParameter, ReportedParameter
from sprung.model.diagnosis.response.forward import mechanics_of
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.diagnosis.response.newton import central_slopes
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.rules import RULES, PlausibleRules
from sprung.model.laws import ElementLaw, StructureLaw, reversal_step
from sprung.model.laws.along import force_along
from sprung.model.laws.base import ParameterSpec
from sprung.model.laws.sensor_faults import OF_CHANNEL
from sprung.model.signals import FloatArray
from sprung.model.system import System

_OWN = ("stiffness", "damping")  # of an element, its force's slopes over deflection and rate


def figures(names: Sequence[str], per_sensor: FloatArray) -> FitFigures:
    """Figures of fit from every sensor's error over its signal, rms over rms, (S,)."""
    return FitFigures(
        nrmse=float(np.sqrt(np.mean(np.asarray(per_sensor) ** 2))),
        per_sensor={name: float(value) for name, value in zip(names, per_sensor, strict=True)},
    )


def deviations(system: System, fit: Fit, reported: int | None = None) -> FloatArray:
    """Standard deviations of the log-ratios, (P,).

    The division between a force that no law of the catalogue explains and the spring and damper beside it is a
    convention: their values are uncertain by what the force would change them.  A spring that is stiffer beyond a gap
    has another stiffness within it.

    reported: how many of the first laws are reported, by default all.  One that is not is a force without a name, too.
    """
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0))[: len(system.parameters)]
    in_time = [number for number, term in enumerate(fit.point.terms) if evaluated_in_time(term)]
    for i, term in enumerate(fit.forces.terms if fit.forces is not None else ()):
        unreported = reported is not None and in_time[i] >= reported
        if (term.law.listed and not unreported) or fit.forces is None:
            continue
        for quantity, share in _linear_shares(fit, fit.forces, i, whole=unreported or not term.law.named).items():
            for j, parameter in enumerate(system.parameters):
                if parameter.element == term.location and parameter.quantity == quantity:
                    value = parameter.nominal * np.exp(fit.point.theta[j])
                    sigma[j] = np.hypot(sigma[j], share / max(value, 1e-300))
    return sigma


def _linear_shares(fit: Fit, forces: LawForces, index: int, *, whole: bool) -> dict[str, float]:
    """Stiffness and damping that may belong to a force: of a formula its own, of a force without a name all of it.

    An estimated surface has none of its own on average; over the motion it has slopes as any force, and any of them may
    be that of the spring or damper alone.  Forces with memory have no slopes.
    """
    term, d, v = forces.terms[index], forces.deflection[:, index], forces.rate[:, index]
    force = forces.force[:, index] + term.equivalent[0] * d + term.equivalent[1] * v
    if not whole:
        columns = np.column_stack([d - np.mean(d), v - np.mean(v)])
        stiffness, damping = np.abs(np.linalg.lstsq(columns, force, rcond=None)[0])
        return {"stiffness": float(stiffness), "damping": float(damping)}
    shares = {name: float(np.std(force)) / max(float(np.std(x)), 1e-300) for name, x in zip(_OWN, (d, v), strict=True)}
    law, element, grid = term.element_law, fit.forward.element_of(term), fit.forward.part.grid
    if law.memory:
        return shares

    def moved(by_d: float, by_v: float) -> FloatArray:
        return force_along(law, term.parameters, d + by_d, v + by_v, grid.start + grid.fine_time, element)

    slopes = zip(_OWN, central_slopes(moved, d, v), strict=True)
    return {name: max(shares[name], float(np.sqrt(np.mean(slope**2)))) for name, slope in slopes}


def reported_parameters(system: System, fit: Fit, reported: int | None = None) -> tuple[ReportedParameter, ...]:
    """Values of a fit with their deviations; reported: how many of the first laws are reported, by default all."""
    sigma = deviations(system, fit, reported)
    values = []
    for i, parameter in enumerate(system.parameters):
        value = parameter.nominal * float(np.exp(fit.point.theta[i]))
        values.append(
            ReportedParameter(parameter.name, value, value * float(sigma[i]), parameter.nominal, parameter.unit)
        )
    return tuple(values)


def _unit_at(system: System, location: str, spec: ParameterSpec) -> str:
    """Unit of a law's parameter at a place: some are in that of the channel there."""
    units = {channel.name: channel.unit for channel in system.channels}
    return units.get(location, spec.unit) if spec.unit == OF_CHANNEL else spec.unit


def input_fault_parameter(system: System, fault: InputFault) -> LawParameter:
    """How large a fault of an input channel is."""
    spec, location = fault.term.law.parameters[0], fault.term.location
    return LawParameter(spec.name, fault.term.parameters[0], fault.std, _unit_at(system, location, spec))


def law_parameters(fit: Fit, index: int, rules: PlausibleRules = RULES.plausible) -> tuple[LawParameter, ...]:
    term, place = fit.point.terms[index], fit.place(index)
    block = _with_corner(fit, term, fit.covariance[place, place])
    size = np.abs(term.parameters)
    accuracy = np.array([spec.accuracy for spec in term.law.parameters])
    followed = accuracy * np.maximum(size, np.abs(term.scales or size))
    errors = rules.simulated * size
    # only forces along elements have kinks between time steps
    total = _with_errors(block, errors) if isinstance(term.law, ElementLaw) else block + np.diag(errors**2)
    sigma = np.sqrt(np.maximum(np.diag(total), 0.0) + followed**2)
    hidden = not term.law.named
    return tuple(
        LawParameter(spec.name, float(value), float(s), _unit_at(fit.forward.system, term.location, spec))
        for spec, value, s in zip(term.law.parameters, term.parameters, sigma, strict=True)
        if not hidden
    )


_STEP = 1e-3  # of a deviation, in which a quoted value moves for its slope


def quoted_values(fit: Fit, index: int) -> tuple[LawParameter, ...]:
    """What engineers quote of a structure with a law; deviations by linear propagation of the fit's covariance."""
    law, system, point = fit.point.terms[index].law, fit.forward.system, fit.point
    if not isinstance(law, StructureLaw) or (quote := law.quoted) is None:
        return ()

    def quoted(moved: FloatArray) -> FloatArray:
        terms = tuple(
            replace(term, parameters=tuple(np.add(term.parameters, moved[fit.place(i)])))
            for i, term in enumerate(point.terms)
        )
        found = quote(mechanics_of(system, point.theta + moved[: len(point.theta)], terms))
        return np.array([value for value, _ in found.values()])

    stated = quote(mechanics_of(system, point.theta, point.terms))
    base = np.array([value for value, _ in stated.values()])
    moves = np.diag(_STEP * np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)))
    free = np.flatnonzero(np.diag(moves))
    slopes = np.array([(quoted(moves[i]) - base) / moves[i, i] for i in free]).reshape(len(free), len(base))
    sigma = np.sqrt(np.einsum("ji,jk,ki->i", slopes, fit.covariance[np.ix_(free, free)], slopes))
    return tuple(
        LawParameter(name, value, float(std), unit)
        for (name, (value, unit)), std in zip(stated.items(), sigma, strict=True)
    )


def _with_errors(covariance: FloatArray, errors: FloatArray) -> FloatArray:
    """Covariance of a law's parameters with further errors of each, propagated to the correlated others.

    The coefficient of a power law has the unit of that power: an error of a thousandth in the exponent changes it by
    five thousandths.
    """
    own = np.diag(covariance)
    free = own > 0
    found: FloatArray = np.diag(np.where(free, np.maximum(own, 0.0), errors**2))
    along = np.where(free, covariance / np.where(free, own, 1.0) * errors, 0.0)  # of every parameter by every error
    return found + np.diag(np.sum(along**2, axis=1))


def _with_corner(fit: Fit, term: Term, covariance: FloatArray) -> FloatArray:
    """Covariance of a law's parameters with the effect of sampling on a corner over the rate.

    A corner of width s is passed in steps of the rate, h each.  The slope there, sech^2(v / s), summed over samples
    instead of integrated is off by 2 x / sinh x cos(phase) of itself, x = pi^2 s / h (Poisson's sum formula).
    """
    corner = term.law.corner
    if corner is None or covariance[corner, corner] <= 0:
        return covariance
    rate = fit.element_motion[1] @ term.port(fit.forward.system)
    passing = reversal_step(rate)
    if passing == 0.0:
        return covariance
    width = term.parameters[corner]
    x = min(np.pi**2 * width / passing, 300.0)
    along = covariance[:, corner] / covariance[corner, corner]  # regression of the others on the width
    found: FloatArray = covariance + 2 * np.outer(along, along) * (width * x / np.sinh(x)) ** 2
    return found


def formula_of(term: Term) -> tuple[str, str]:
    """Formulas of the force and of its hidden state's rate; empty for laws of the catalogue."""
    law = term.law
    return (law.formula, law.memory_formula) if law.of_formula else ("", "")
