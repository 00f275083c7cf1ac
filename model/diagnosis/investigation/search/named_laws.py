"""Several named laws as an alternative to an unnamed force or a formula, which explains more than each of them alone.

A valve and a stop of one strut are found one after the other if one of them leads the competition.  If an unnamed force
explains far more than either, it leads, and no other law is tried at its place; a formula may be their sum.  The search
is then repeated without unnamed forces, and its result is kept if it explains nearly everything that the unnamed force
does, or as much as the formula by evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation, Progress, share_done
from sprung.model.diagnosis.selection.compete import cost, noise_bound
from sprung.model.diagnosis.selection.evidence import profile_gain


def with_named_laws(
    before: Investigation, unnamed: Investigation, search: Callable[[Investigation], Investigation], progress: Progress
) -> Investigation:
    """The investigation with named laws if they explain as much as the unnamed force, else that with the force.

    before: without that force; search: findings until the residual is noise.  A formula is kept if its residual is
    smaller than that of the named laws or, where both leave noise, if it is a single shape or its evidence is higher.
    """
    last = unnamed.found[-1]
    if unnamed.problem.process_noise or _needs_no_names(unnamed):
        return unnamed
    progress(share_done(len(before.found) + 0.5), "named laws in place of an unnamed force")
    named = search(replace(before, options=replace(before.options, unnamed=False), tried=unnamed.tried))
    if len(named.found) <= len(before.found) or not _explains_as_much(before, unnamed, named):
        return unnamed
    if _is_formula(last):
        unnamed = search(unnamed)  # further findings beside a formula count like those beside named laws
        if not _explains_as_much(before, unnamed, named):
            return unnamed
    return replace(named, options=before.options)


def _needs_no_names(unnamed: Investigation) -> bool:
    """Whether the last finding is named, or a formula of one shape, which is no sum of laws, that leaves noise."""
    last = unnamed.found[-1]
    if not _is_formula(last):
        return last.trial.named
    return last.trial.term.element_law.strength is not None and _excess_chi_square(unnamed, unnamed) == 0


def with_laws_together(state: Investigation, search: Callable[[Investigation], Investigation]) -> Investigation:
    """The investigation, whose search has ended, with further named laws if these leave nearly nothing but noise.

    A clearance and a stop are first identified as a cubic spring; each of them is small beside it, and both replace it.
    """
    if not state.found or not state.options.unnamed or state.problem.process_noise:
        return state
    if _excess_chi_square(state, state) == 0:
        return state
    named = search(replace(state, options=replace(state.options, unnamed=False)))
    if named.found is state.found or not _explains_as_much(state, state, named):
        return state
    return replace(named, options=state.options)


def _is_formula(found: AcceptedFinding) -> bool:
    return found.trial.term.law.of_formula


def _explains_as_much(before: Investigation, unnamed: Investigation, named: Investigation) -> bool:
    """Whether the residual of the named laws is nearly noise, at the noise levels estimated with the unnamed force."""
    most = before.options.rules.formula.leaves * _excess_chi_square(before, unnamed)
    if any(_is_formula(found) for found in unnamed.found[len(before.found) :]):
        if named.fit.bounded:  # values at their bounds are no better than a formula
            return False
        most = min(most, _excess_chi_square(unnamed, unnamed))
    if _excess_chi_square(named, unnamed) > most or (most == 0 and _evidence(before, unnamed, named) < 0):
        return False
    return not (before.options.held_out and unnamed.held.compare(unnamed.fit, named.fit).refuted)


def _evidence(before: Investigation, unnamed: Investigation, named: Investigation) -> float:
    """Evidence of the named laws over the formula, each beside its further findings."""
    rules, judge = before.options.rules.evidence, unnamed.fit
    residual = judge.whitener(named.fit.spectrum, unnamed.problem.part)
    gain = profile_gain(judge.residual, residual, len(unnamed.problem.sensors), rules.quiet, rules)
    first = before.given + len(before.found)
    costs = [
        sum(cost(state.fit, rules, index) for index in range(first, len(state.fit.point.terms)))
        for state in (unnamed, named)
    ]
    return gain + costs[0] - costs[1]


def _excess_chi_square(state: Investigation, judge: Investigation) -> float:
    """Chi-square per degree of freedom beyond noise, with the weights of another investigation."""
    fit = state.fit
    residual = judge.fit.whitener(fit.spectrum, judge.problem.part)
    reduced = float(residual @ residual) / max(1, fit.count - fit.jacobian.shape[1])
    return float(max(0.0, reduced - noise_bound(judge.problem, fit)))
