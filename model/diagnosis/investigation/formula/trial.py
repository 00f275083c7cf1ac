"""A formula in competition with the named laws and unnamed forces of one step of an investigation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.investigation.formula.rejection import missing
from sprung.model.diagnosis.investigation.formula.search import excess_chi_square, formula_of
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import evaluated_in_time
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.diagnosis.selection.evidence import chance


def with_formula(state: Investigation, plain: list[Trial], trials: list[Trial]) -> tuple[list[Trial], tuple[str, ...]]:
    """Trials with a formula of the leading unnamed force in front, if one is accepted; a note if none is.

    A named law that was preferred to an unnamed force, or that leaves much of the misfit, is replaced only by a formula
    that explains more than it; one that leaves little, but explains less than the unnamed force, by a formula that is
    far more likely.  Where no single formula is, and the unnamed force is as plain as the law, the law is not named.
    """
    leader = _force_to_express(state, plain)
    if leader is None or state.problem.process_noise or not state.options.unnamed:
        return trials, ()
    formula, reason = _formula(state, leader)
    if formula is not None and _replaces(state, trials[0], formula):
        return [formula, *(trial for trial in trials if trial is not leader or trial.named)], ()
    if formula is not None or not (leader is trials[0] or _is_likelier(state, leader, trials[0])):
        return trials, ()
    trials = [leader, *(trial for trial in trials if trial is not leader)]
    place = leader.term.location
    return trials, (f"{place}: surface only; {reason}",)


def _formula(state: Investigation, leader: Trial) -> tuple[Trial | None, str]:
    """The formula of an unnamed force, or None and the reason, with a share of the work that is left."""
    work = state.problem.work
    own = None if work is None else work.portion(state.options.rules.formula.work)
    with np.errstate(all="ignore"):  # trial formulas overflow
        found = formula_of(replace(state.problem, work=own), state.fit, leader, state.held)
    if work is not None and own is not None:
        work.gather([own])
    return found


def _replaces(state: Investigation, leader: Trial, formula: Trial) -> bool:
    """Whether a formula replaces the leading trial."""
    rules = state.options.rules.formula
    if not leader.named or formula.explains > rules.beyond * leader.explains:
        return True
    settled = excess_chi_square(state.problem, leader.fit) == 0
    single = formula.term.element_law.strength is not None  # the second of two shapes may belong to another law
    return settled and single and formula.evidence > leader.evidence + rules.likelier


def _is_likelier(state: Investigation, force: Trial, law: Trial) -> bool:
    """Whether an unnamed force is likelier than a law that leaves only noise, and no more flexible.

    Flexible forces may take on what the simulation of a law has wrong; one as plain as the law is another law's.
    """
    settled = excess_chi_square(state.problem, law.fit) == 0
    as_plain = not force.named and force.freedom <= law.freedom and force.term.location == law.term.location
    return settled and as_plain and force.evidence > law.evidence


def _force_to_express(state: Investigation, plain: list[Trial]) -> Trial | None:
    """The trial whose force is to be expressed by a formula; None: none.

    That is the leading trial if it is unnamed; the best force of an element if the leader is named and leaves much of
    the misfit (but not the leader itself if the residual does not depend on its element's motion), or explains
    significantly less than that force; or a named leader whose residual depends on its element's motion.
    """
    leader, rules = plain[0], state.options.rules.formula
    if not leader.named:
        return leader
    forces = [one for one in plain if evaluated_in_time(one.term) and one.term.location in state.system.elements]
    own = any(leader is one for one in forces)
    if excess_chi_square(state.problem, leader.fit) > rules.leaves * excess_chi_square(state.problem, state.fit):
        best = next(iter(forces), None)  # unless the residual belongs to another place
        return None if best is leader and missing(state.problem, leader.fit) <= rules.missing else best
    for force in forces:
        if not force.named and leader.gain < rules.explains * force.gain:
            luck = chance(force.gain - leader.gain, max(1, force.freedom - leader.freedom), 1)
            return force if luck < state.options.rules.acceptance.alpha else None
    return leader if own and missing(state.problem, leader.fit) > rules.missing else None
