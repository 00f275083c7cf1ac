"""Sentences of findings, with the bias that the unmodelled effect caused."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.investigation.state import Outcome
from sprung.model.diagnosis.report.report import Finding
from sprung.model.diagnosis.report.values import deviations
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws.basis import UNKNOWN


def sentence_of(outcome: Outcome, term: Term, finding: Finding) -> str:
    values = {p.name: p.words() for p in finding.parameters}
    values["all"] = ", ".join(values.values())
    try:
        words = _formula_in_words(finding) if finding.formula else term.law.sentence.format(**values)
    except (KeyError, IndexError):
        words = term.law.title
    words += term.law.axis_in_words(term.variant)
    if finding.family is not None:
        words = f"{names_in_words(finding.family)}, which this recording cannot distinguish; as the first, {words}"
    if finding.elsewhere:
        others = " or ".join(place.replace("|", " and ") for place in finding.elsewhere)
        words += f" (or as much at {others}, which this recording cannot distinguish)"
    sentence = f"{term.location.replace('|', ' and ')}: {words}"
    found = outcome.investigation.found
    bias = _worst_bias(outcome, "without it" if len(found) == 1 else "without these findings")
    if bias is not None and found[0].trial.term.key[:2] == term.key[:2]:  # the common bias is stated once
        sentence += f"; {bias}"
    return sentence


def names_in_words(family: str) -> str:
    """Names of look-alikes, such as "bump_stop or unknown", as words."""
    names = family.split(" or ")
    return " or ".join("a force without a name" if name == UNKNOWN else name.replace("_", " ") for name in names)


def _formula_in_words(finding: Finding) -> str:
    """A formula with its values, in words."""
    values = ", ".join(f"{p.name} = {p.words()}" for p in finding.parameters)
    hidden = f" with z' = {finding.memory}" if finding.memory else ""
    return f"a force that no law of the catalogue explains, by regression {finding.formula}{hidden} ({values})"


def _worst_bias(outcome: Outcome, without: str) -> str | None:
    """The bias of the parameter that was affected most, in words; None if it is small."""
    state, final = outcome.investigation, outcome.final
    sigma = deviations(state.system, final)
    shift = state.base.point.theta - final.point.theta
    if not len(shift):
        return None
    shift = np.where(np.abs(shift) > state.options.rules.report.sure * sigma, shift, 0.0)
    worst = int(np.argmax(np.abs(shift)))
    if abs(shift[worst]) < state.options.rules.report.bias:
        return None
    change = 100 * (np.exp(shift[worst]) - 1)
    side = "high" if change > 0 else "low"
    if np.exp(shift[worst]) > state.options.rules.report.no_longer:
        return f"{state.system.parameters[worst].name} is then no longer needed"
    return f"{without} {state.system.parameters[worst].name} was read {abs(change):.0f} % too {side}"
