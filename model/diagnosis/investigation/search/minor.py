"""Selection of the candidates that are tried after the findings so far, and of trials too small to be findings."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import INPUT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.diagnosis.selection.plausible import harmonic, hum
from sprung.model.laws import COMPRESSION, EXTENSION, BodyLaw, Law, StructureLaw


def untried(state: Investigation, candidates: Iterable[Candidate]) -> list[Candidate]:
    """Candidates to be tried: no input faults, not found before, and no harmonics of the excitation or the mains."""
    return [
        h
        for h in sought(state, candidates)
        if h.family is not INPUT
        and not _repeats(state, h)
        and not _hopeless(state, h)
        and harmonic(state.problem.part, h.term, state.options.rules.plausible) is None
        and hum(state.problem.part, h.term, state.options.rules.plausible) is None
    ]


def sought(state: Investigation, candidates: Iterable[Candidate]) -> list[Candidate]:
    """The candidates without unnamed forces where these are not sought, and only those of the sensor in question."""
    here = [h for h in candidates if state.only in ("", h.location)]
    return [h for h in here if state.options.unnamed or h.term.law.named]


def _repeats(state: Investigation, candidate: Candidate) -> bool:
    """Whether a candidate is a law that was found at its place, or any law where an unnamed force was found."""
    for term in state.fit.point.terms:
        if candidate.term.key[:2] == term.key[:2] and not _are_two_sides(candidate.term, term):
            return True
        if candidate.location == term.location and not term.law.listed:
            return True
    return False


def _are_two_sides(one: Term, other: Term) -> bool:
    """Whether two terms of a law act in the two directions of a deflection."""
    return {one.variant, other.variant} == {EXTENSION, COMPRESSION}


def _hopeless(state: Investigation, candidate: Candidate) -> bool:
    """Whether a candidate at the place of a finding would be minor even if it fitted as well as its score promises.

    Only with process noise: there the predicted decrease of chi-square is a share of the unmeasured forces.
    """
    if not state.problem.process_noise:
        return False
    there = [found.trial for found in state.found if found.trial.term.location == candidate.location]
    if there and not candidate.term.law.named:
        return True
    rules = state.options.rules.acceptance
    left = float(np.sum(state.fit.noise.force**2))
    promised = rules.better_than_promised * left * candidate.score / state.fit.chi_square
    return any(promised < min(rules.minor_beside * trial.reduction, rules.most_left * left) for trial in there)


def is_minor(state: Investigation, trial: Trial) -> bool:
    """Whether a trial explains too little beside the findings: a small residual is an inaccuracy of their laws."""
    if _absorbed(state, trial):
        return True
    rules = state.options.rules.acceptance
    even = (found.trial.gain for found in state.found if found.trial.term.law.everywhere)
    if trial.term.law.part and trial.gain < rules.minor_beside * max(even, default=0.0):
        return True  # material damping varies over frequency more than its law
    least = rules.minor_followed if state.problem.process_noise else rules.minor_elsewhere
    elsewhere = [found.trial.gain for found in state.found if found.trial.term.location != trial.term.location]
    if trial.gain < least * sum(elsewhere):  # inaccuracies of all laws add up
        return True
    for index, found in enumerate(state.found):
        if found.trial.term.location != trial.term.location:
            continue
        if not trial.named:
            return True
        if state.problem.process_noise:
            left = float(np.sum(state.fit.noise.force**2))
            if trial.reduction < min(rules.minor_beside * found.trial.reduction, rules.most_left * left):
                return True
        elif _is_minor_beside(state, index, trial):
            return True
    return False


def _is_minor_beside(state: Investigation, index: int, trial: Trial) -> bool:
    """Whether a second law at the element of a finding may be an inaccuracy of the first.

    That is a small one, unless it explains most of what is no noise, and a very small one in any case.  Laws that are
    sought in place of an unnamed force are judged together (`named_laws`).
    """
    rules = state.options.rules.acceptance
    first = _wald_statistic(state.fit, state.given + index, state.found[index].trial.term.law)
    if trial.reduction < rules.minor_elsewhere * first:
        return True
    alone = state.options.unnamed
    return alone and trial.reduction < rules.minor_beside * first and not _explains_most_of_the_rest(state, trial)


def _explains_most_of_the_rest(state: Investigation, trial: Trial) -> bool:
    """Whether a trial explains most of the residual's power beyond the expected one of noise."""
    noise = state.fit.count - state.fit.jacobian.shape[1]
    return bool(trial.reduction > state.options.rules.verdict.carried * (state.fit.chi_square - noise))


def _absorbed(state: Investigation, trial: Trial) -> bool:
    """Whether a structural change at the bodies of an unnamed force explains less than that force, and so its error."""
    if not isinstance(trial.term.law, StructureLaw | BodyLaw):
        return False
    parts, elements = set(trial.term.location.split("|")), state.system.file.elements
    unlisted = [found.trial for found in state.found if not found.trial.term.law.listed]
    stronger = [one.term.location for one in unlisted if one.gain > trial.gain and one.term.location in elements]
    return any(parts & {place, elements[place].upper, elements[place].lower} for place in stronger)


def _wald_statistic(fit: Fit, index: int, found: Law) -> float:
    """Wald statistic of a term: the rise of chi-square without it, from its strength and its standard deviation.

    Of several values, such as the two sides of a stop, the one nearest to its absence.
    found: its law before it was widened, which has one strength where the wider form may have two.
    """
    term, place = fit.point.terms[index], fit.place(index)
    if not term.parameters:
        return 0.0
    absent = np.where(np.isfinite(term.law.absent), term.law.absent, 0.0)
    variances = np.maximum(np.diag(fit.covariance)[place], 1e-300)
    statistics = np.subtract(term.parameters, absent) ** 2 / variances
    return float(np.min(statistics) if found.strength is None else statistics[found.strength])
