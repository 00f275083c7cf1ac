"""Calibration errors within tolerance (gains, zeros, masses), reported beside the findings."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sprung.model.diagnosis.investigation.measurements.calibration import calibration_indices, faulty
from sprung.model.diagnosis.investigation.measurements.data_sheets import within_data_sheet, within_tolerance
from sprung.model.diagnosis.investigation.state import Outcome
from sprung.model.diagnosis.report.report import IdentifiedLaw
from sprung.model.diagnosis.report.values import input_fault_parameter, law_parameters
from sprung.model.laws import Law

_SHOWN = 4  # in the summary


def calibration_of(outcome: Outcome) -> tuple[IdentifiedLaw, ...]:
    """Errors above their standard deviation, most significant first; a common gain of all channels is unobservable."""
    state, final = outcome.investigation, outcome.final
    faults = faulty(state)
    indices = [index for index in calibration_indices(state) if index not in faults]
    terms = state.fit.point.terms
    indices += [state.given + at for at in range(len(state.found)) if within_tolerance(state, terms[state.given + at])]
    found = []
    for index in indices:
        term = terms[index]
        (parameter,) = law_parameters(final, index, state.options.rules.plausible)
        found.append((abs(parameter.value - term.law.absent[0]) / parameter.std, term, parameter))
    for fault in state.input_faults:
        if within_tolerance(state, fault.term):
            parameter = input_fault_parameter(state.system, fault)
            away = abs(parameter.value - fault.term.law.absent[0]) / max(fault.std, 1e-300)
            found.append((away, fault.term, parameter))
    significant = [one for one in found if one[0] > 1]
    significant.sort(key=lambda one: -one[0])
    return tuple(IdentifiedLaw(term.location, term.law.name, (parameter,)) for _, term, parameter in significant)


def beyond_tolerance(outcome: Outcome) -> frozenset[tuple[str, str]]:
    """Place and effect of the errors above their tolerance, which their deviations do not distinguish from it."""
    state = outcome.investigation
    terms = [state.fit.point.terms[index] for index in calibration_indices(state)]
    return frozenset((term.location, term.law.name) for term in terms if not within_data_sheet(state, term))


def in_words(
    calibration: Sequence[IdentifiedLaw], catalogue: Sequence[Law], beyond: Collection[tuple[str, str]] = ()
) -> str:
    """Summary; empty without calibration errors.  beyond: place and effect of those above their tolerance."""
    quantities = {law.name: f"{law.scales} " for law in catalogue if law.scales}
    within = [one for one in calibration if (one.location, one.effect) not in beyond]
    uncertain = [one for one in calibration if (one.location, one.effect) in beyond]
    parts = [f"within calibration: {_listed(within, quantities)}"] if within else []
    if uncertain:
        parts.append(f"too uncertain to be called a fault: {_listed(uncertain, quantities)}")
    return "; ".join(parts)


def _listed(calibration: Sequence[IdentifiedLaw], quantities: dict[str, str]) -> str:
    shown = [
        f"{one.location} {quantities.get(one.effect, '')}{parameter.name} {parameter.words()}"
        for one in calibration[:_SHOWN]
        for parameter in one.parameters
    ]
    return ", ".join(shown) + (f" and {len(calibration) - _SHOWN} more" if len(calibration) > _SHOWN else "")
