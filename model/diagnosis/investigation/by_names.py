"""Several laws in the place of a force without a name: each alone explains much less than a force of free shape.

A valve and a stop of one strut are found one after the other where the first leads; where a force of free shape says
far more than either, it leads, and nothing else is sought at its place.  So laws with names are sought a second time,
without such forces, and stand where they leave next to nothing that the unnamed force explains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sprung.model.diagnosis.investigation.state import Found, Investigation, Progress
from sprung.model.diagnosis.selection.compete import noise_bound
from sprung.model.laws import ElementLaw


def by_names(
    before: Investigation, unnamed: Investigation, search: Callable[[Investigation], Investigation], tell: Progress
) -> Investigation:
    """The investigation whose findings have names, where they say as much as the last one's unnamed force; else that.

    before: without that force; search: for findings until the rest is noise.  A formula stands where it leaves noise,
    and elsewhere where it leaves less than the names do.
    """
    if unnamed.problem.process_noise or _settled(unnamed):
        return unnamed
    tell(0.3 + 0.17 * len(before.found), "laws with names in the place of a force without")
    named = search(replace(before, options=replace(before.options, unnamed=False)))
    if len(named.found) <= len(before.found) or not _says_as_much(before, unnamed, named):
        return unnamed
    if _is_formula(unnamed.found[-1]):
        unnamed = search(unnamed)  # what else there is beside a formula counts as what is beside names does
        if not _says_as_much(before, unnamed, named):
            return unnamed
    return replace(named, options=before.options)


def _settled(unnamed: Investigation) -> bool:
    """Whether the last finding has a name, or is a formula that leaves noise alone."""
    trial = unnamed.found[-1].trial
    return trial.named and not (_is_formula(unnamed.found[-1]) and _left(unnamed, unnamed) > 0)


def _is_formula(found: Found) -> bool:
    law = found.trial.term.law
    return isinstance(law, ElementLaw) and law.of_formula


def _says_as_much(before: Investigation, unnamed: Investigation, named: Investigation) -> bool:
    """Whether laws with names leave next to nothing, by the noise beside the unnamed force."""
    most = before.options.rules.formula.leaves * _left(before, unnamed)
    if any(_is_formula(found) for found in unnamed.found[len(before.found) :]):
        if named.fit.bounded:  # laws at the ends of what they can be: no better than a formula
            return False
        most = min(most, _left(unnamed, unnamed))
    if _left(named, unnamed) > most:
        return False
    return not (before.options.held_out and unnamed.held.compare(unnamed.fit, named.fit).refuted)


def _left(state: Investigation, judge: Investigation) -> float:
    """Chi-square per degree of freedom beyond noise, weighed as another investigation has it."""
    fit = state.fit
    residual = judge.fit.whitener(fit.spectrum, judge.problem.part)
    reduced = float(residual @ residual) / max(1, fit.count - fit.jacobian.shape[1])
    return float(max(0.0, reduced - noise_bound(judge.problem, fit)))
