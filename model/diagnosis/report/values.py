"""Numbers of a fit as they are reported: values with deviations, of parameters and of laws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.state import InputFault
from sprung.model.diagnosis.report.report import FitFigures, LawParameter, ReportedParameter
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES, PlausibleRules
from sprung.model.laws import ElementLaw, reversal_step
from sprung.model.laws.base import ParameterSpec
from sprung.model.laws.sensor_faults import OF_CHANNEL
from sprung.model.signals import FloatArray
from sprung.model.system import System


def figures(names: Sequence[str], per_sensor: FloatArray) -> FitFigures:
    return FitFigures(
        nrmse=float(np.sqrt(np.mean(np.asarray(per_sensor) ** 2))),
        per_sensor={name: float(value) for name, value in zip(names, per_sensor, strict=True)},
    )


def deviations(system: System, fit: Fit) -> FloatArray:
    """Standard deviations of the log-ratios, (P,).

    What of an unnamed force belongs to the spring and damper that it works beside is a matter of convention: their
    own values are uncertain by as much as the whole of it would change them.
    """
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0))[: len(system.parameters)]
    for i, term in enumerate(fit.forces.terms if fit.forces is not None else ()):
        if term.law.named or fit.forces is None:
            continue
        d, v = fit.forces.deflection[:, i], fit.forces.rate[:, i]
        force = np.std(fit.forces.force[:, i] + term.equivalent[0] * d + term.equivalent[1] * v)
        for j, parameter in enumerate(system.parameters):
            if parameter.element == term.location and parameter.quantity != "mass":
                along = np.std(d if parameter.quantity == "stiffness" else v)
                value = parameter.nominal * np.exp(fit.point.theta[j])
                sigma[j] = np.hypot(sigma[j], force / max(along * value, 1e-300))
    return sigma


def reported_parameters(system: System, fit: Fit) -> tuple[ReportedParameter, ...]:
    sigma = deviations(system, fit)
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
    # only forces along an element have kinks that are simulated in steps: a sine or a dip is exact in its own time
    told = _with_errors(block, errors) if isinstance(term.law, ElementLaw) else block + np.diag(errors**2)
    sigma = np.sqrt(np.maximum(np.diag(told), 0.0) + followed**2)
    hidden = not term.law.named
    return tuple(
        LawParameter(spec.name, float(value), float(s), _unit_at(fit.forward.system, term.location, spec))
        for spec, value, s in zip(term.law.parameters, term.parameters, sigma, strict=True)
        if not hidden
    )


def _with_errors(covariance: FloatArray, errors: FloatArray) -> FloatArray:
    """Covariance of a law's parameters with errors of each, which the others follow as the recording ties them.

    What yields as a power of its deflection has a size in the unit of that power: an exponent that simulation leaves
    off by a thousandth moves it by five.
    """
    own = np.diag(covariance)
    told = own > 0
    found: FloatArray = np.diag(np.where(told, np.maximum(own, 0.0), errors**2))
    along = np.where(told, covariance / np.where(told, own, 1.0) * errors, 0.0)  # of every parameter by every error
    return found + np.diag(np.sum(along**2, axis=1))


def _with_corner(fit: Fit, term: Term, covariance: FloatArray) -> FloatArray:
    """Covariance of a law's parameters with what sampling leaves open of a corner over the rate.

    A corner of width s is passed in steps of the rate, h each.  The slope there, sech^2(v / s), summed over samples
    instead of integrated is off by 2 x / sinh x cos(phase) of itself, x = pi^2 s / h (Poisson's sum formula).
    """
    corner = term.law.corner if isinstance(term.law, ElementLaw) else None
    if corner is None or covariance[corner, corner] <= 0:
        return covariance
    rate = fit.element_motion[1] @ term.port(fit.forward.system)
    passing = reversal_step(rate)
    if passing == 0.0:
        return covariance
    width = term.parameters[corner]
    x = min(np.pi**2 * width / passing, 300.0)
    along = covariance[:, corner] / covariance[corner, corner]  # what the others do when the width is off
    found: FloatArray = covariance + 2 * np.outer(along, along) * (width * x / np.sinh(x)) ** 2
    return found


def formula_of(term: Term) -> tuple[str, str]:
    """Text of the force and of its hidden state's rate, of a law that is known by them alone; empty for others."""
    law = term.law
    return (law.formula, law.memory_formula) if isinstance(law, ElementLaw) and law.of_formula else ("", "")
