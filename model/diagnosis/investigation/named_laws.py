"""Several named laws as an alternative to an unnamed (non-parametric) force, which explains more than each alone.

A valve and a stop of one strut are found one after the other if one of them leads the competition.  If an unnamed force
explains far more than either, it leads, and no other law is tried at its place.  The search is then repeated without
unnamed forces, and its result is kept if it explains nearly everything that the unnamed force does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation, Progress
from sprung.model.diagnosis.selection.compete import noise_bound
from sprung.model.laws import ElementLaw


def with_named_laws(
    before: Investigation, unnamed: Investigation, search: Callable[[Investigation], Investigation], progress: Progress
) -> Investigation:
    """The investigation with named laws if they explain as much as the unnamed force, else that with the force.

    before: without that force; search: findings until the residual is noise.  A formula is kept if its residual is
    noise, or smaller than that of the named laws.
    """
    if unnamed.problem.process_noise or _needs_no_names(unnamed):
        return unnamed
    progress(0.3 + 0.17 * len(before.found), "named laws in place of an unnamed force")
    named = search(replace(before, options=replace(before.options, unnamed=False)))
    if len(named.found) <= len(before.found) or not _explains_as_much(before, unnamed, named):
        return unnamed
    if _is_formula(unnamed.found[-1]):
        unnamed = search(unnamed)  # further findings beside a formula count like those beside named laws
        if not _explains_as_much(before, unnamed, named):
            return unnamed
    return replace(named, options=before.options)


def _needs_no_names(unnamed: Investigation) -> bool:
    """Whether the last finding is named, or a formula whose residual is noise."""
    trial = unnamed.found[-1].trial
    return trial.named and not (_is_formula(unnamed.found[-1]) and _excess_chi_square(unnamed, unnamed) > 0)


def _is_formula(found: AcceptedFinding) -> bool:
    law = found.trial.term.law
    return isinstance(law, ElementLaw) and law.of_formula


def _explains_as_much(before: Investigation, unnamed: Investigation, named: Investigation) -> bool:
    """Whether the residual of the named laws is nearly noise, at the noise levels estimated with the unnamed force."""
    most = before.options.rules.formula.leaves * _excess_chi_square(before, unnamed)
    if any(_is_formula(found) for found in unnamed.found[len(before.found) :]):
        if named.fit.bounded:  # values at their bounds are no better than a formula
            return False
        most = min(most, _excess_chi_square(unnamed, unnamed))
    if _excess_chi_square(named, unnamed) > most:
        return False
    return not (before.options.held_out and unnamed.held.compare(unnamed.fit, named.fit).refuted)


def _excess_chi_square(state: Investigation, judge: Investigation) -> float:
    """Chi-square per degree of freedom beyond noise, with the weights of another investigation."""
    fit = state.fit
    residual = judge.fit.whitener(fit.spectrum, judge.problem.part)
    reduced = float(residual @ residual) / max(1, fit.count - fit.jacobian.shape[1])
    return float(max(0.0, reduced - noise_bound(judge.problem, fit)))
