"""An unnamed force as a formula: a grammar searched by score tests, the best sums fitted inside the simulation.

Shapes of `model.laws.grammar`, alone and in pairs, are scored along the motion that the unnamed force has shaped
(`formula_search`); the best few are refitted as laws beside everything else, and one is accepted if it explains as much
as the unnamed force, by evidence and on the held-out part, and leaves little of the misfit: a formula of half of a
force is none.
"""

from __future__ import annotations

from dataclasses import replace

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.formula.rejection import doubt_of
from sprung.model.diagnosis.investigation.formula.shapes import FormulaSearch
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial, by_evidence, compete, noise_bound
from sprung.model.diagnosis.selection.holdout import HeldOut

_NO_FORMULA = "no formula of the grammar explains as much as the measured force map"


def formula_of(problem: Problem, base: Fit, unnamed: Trial, held: HeldOut) -> tuple[Trial | None, str]:
    """The formula of an unnamed force, or None (only its surface is known) and the reason.

    base: the model without it.  Pairs are fitted if a single shape leaves a residual; if no formula is accepted, shapes
    are scored again along the motion of the best one.
    """
    leader, reason = unnamed.fit, _NO_FORMULA
    for _ in range(problem.rules.formula.rounds):
        search = FormulaSearch.along(problem, leader)
        singles, pairs = search.best()
        if not _promising(problem, base, search, [*singles, *pairs]):
            break
        trials = compete(problem, base, singles)
        found, reason = _accepted(problem, base, trials, unnamed, held)
        if found is None or excess_chi_square(problem, found.fit) > 0:
            trials = by_evidence(problem, base, [*trials, *compete(problem, base, pairs)])
            found, reason = _accepted(problem, base, trials, unnamed, held)
            if found is not None:  # along its motion a single shape may suffice
                singles, _ = FormulaSearch.along(problem, found.fit).best()
                trials = by_evidence(problem, base, [*trials, *compete(problem, base, singles)])
                found, reason = _accepted(problem, base, trials, unnamed, held)
        if found is not None:
            return _without_variant(found), ""
        leader = min((trial.fit for trial in trials if trial.finished), key=lambda fit: fit.deviance, default=leader)
        if leader is unnamed.fit:
            break
    return None, reason


def _accepted(
    problem: Problem, base: Fit, trials: list[Trial], unnamed: Trial, held: HeldOut
) -> tuple[Trial | None, str]:
    """The simplest formula near the best of those that explain as much as the unnamed force, or why there is none.

    A formula with one value more that the recording does not determine, such as a * cos(d / L) instead of a * d**2, may
    lead by chance; it is no reason against the other.
    """
    equivalent: list[Trial] = []  # trials come by evidence
    for trial in trials:
        if equivalent and trial.evidence <= equivalent[0].evidence - problem.rules.report.naming_margin:
            break
        if _explains(problem, base, trial, unnamed, held):
            equivalent.append(trial)
    equivalent.sort(key=lambda trial: len(trial.term.parameters))  # stable: of equally many values by evidence
    reason = ""
    for trial in equivalent:
        doubt = doubt_of(problem, trial, trials)
        if not doubt:
            return trial, ""
        reason = reason or doubt
    return None, reason or _NO_FORMULA


def _explains(problem: Problem, base: Fit, trial: Trial, unnamed: Trial, held: HeldOut) -> bool:
    """Whether a formula explains as much as the unnamed force and leaves little of the misfit."""
    rules = problem.rules.formula
    if not problem.process_noise and excess_chi_square(problem, trial.fit) > rules.leaves * excess_chi_square(
        problem, base
    ):
        return False
    explains = trial.evidence >= unnamed.evidence - rules.slack and trial.gain >= rules.explains * unnamed.gain
    return trial.finished and explains and not trial.fit.bounded and not held.compare(unnamed.fit, trial.fit).refuted


def _promising(problem: Problem, base: Fit, search: FormulaSearch, candidates: list[Candidate]) -> bool:
    """Whether the residual predicted by the best score is small enough for fits to be worthwhile."""
    residual = search.motion.projector.residual
    most = max((candidate.score for candidate in candidates), default=0.0)
    promised = (float(residual @ residual) - most) / max(1, base.count - base.jacobian.shape[1])
    most_left = problem.rules.formula.hopeful * excess_chi_square(problem, base)
    return bool(promised - noise_bound(problem, base) < most_left)


def excess_chi_square(problem: Problem, fit: Fit) -> float:
    """Chi-square per degree of freedom beyond the bound of noise."""
    return max(fit.reduced - noise_bound(problem, fit), 0.0)


def _without_variant(trial: Trial) -> Trial:
    """A trial without the variant that distinguished formulas during the search."""
    point = trial.fit.point
    term = replace(point.terms[-1], variant="")
    return replace(trial, fit=replace(trial.fit, point=replace(point, terms=(*point.terms[:-1], term))))
