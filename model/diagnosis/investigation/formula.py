"""An unnamed force as a formula: a grammar searched by score tests, the best sums fitted inside the simulation.

Shapes of `model.laws.grammar`, alone and in pairs, are scored along the motion that the unnamed force has shaped
(`formula_search`); the best few are refitted as laws beside everything else, and one is believed where it says as much
as the unnamed force with all its freedom did, by evidence and on the held-out part, and leaves little of what was
there: half of a force has no formula.
"""

from __future__ import annotations

from dataclasses import replace

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.formula_doubt import doubt_of
from sprung.model.diagnosis.investigation.formula_search import FormulaSearch
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial, compete, graded, noise_bound
from sprung.model.diagnosis.selection.holdout import HeldOut

_LITTLE = "no formula of the grammar says as much as the measured force map"


def formula_of(problem: Problem, base: Fit, unnamed: Trial, held: HeldOut) -> tuple[Trial | None, str]:
    """The formula of an unnamed force; None: only its surface is known, and why.

    base: the model without it.  Pairs are fitted where a single shape leaves anything; where no formula is believed,
    they are scored again along the motion of the best one.
    """
    leader, reason = unnamed.fit, _LITTLE
    for _ in range(problem.rules.formula.rounds):
        search = FormulaSearch.along(problem, leader)
        singles, pairs = search.best()
        if not _hopeful(problem, base, search, [*singles, *pairs]):
            break
        trials = compete(problem, base, singles)
        found, reason = _told(problem, base, trials, unnamed, held)
        if found is None or left(problem, found.fit) > 0:
            trials = graded(problem, base, [*trials, *compete(problem, base, pairs)])
            found, reason = _told(problem, base, trials, unnamed, held)
            if found is not None:  # a single shape may do along its motion, where it did not along the unnamed force's
                singles, _ = FormulaSearch.along(problem, found.fit).best()
                trials = graded(problem, base, [*trials, *compete(problem, base, singles)])
                found, reason = _told(problem, base, trials, unnamed, held)
        if found is not None:
            return _plain(found), ""
        leader = min((trial.fit for trial in trials if trial.finished), key=lambda fit: fit.deviance, default=leader)
        if leader is unnamed.fit:
            break
    return None, reason


def _told(problem: Problem, base: Fit, trials: list[Trial], unnamed: Trial, held: HeldOut) -> tuple[Trial | None, str]:
    """The formula that is believed and beyond doubt, or why none is."""
    best = _believed(problem, base, trials, unnamed, held)
    if best is None:
        return None, _LITTLE
    doubt = doubt_of(problem, best, trials)
    return (None, doubt) if doubt else (best, "")


def _believed(problem: Problem, base: Fit, trials: list[Trial], unnamed: Trial, held: HeldOut) -> Trial | None:
    """The formula of most evidence that says as much as the unnamed force, and nearly everything that is to be said."""
    rules = problem.rules.formula
    for trial in trials:
        if not problem.process_noise and left(problem, trial.fit) > rules.leaves * left(problem, base):
            continue
        says = trial.evidence >= unnamed.evidence - rules.slack and trial.gain >= rules.says * unnamed.gain
        if trial.finished and says and not trial.fit.bounded and not held.compare(unnamed.fit, trial.fit).refuted:
            return trial
    return None


def _hopeful(problem: Problem, base: Fit, search: FormulaSearch, candidates: list[Candidate]) -> bool:
    """Whether the best score promises to leave little enough to be worth fits."""
    residual = search.motion.projector.residual
    most = max((candidate.score for candidate in candidates), default=0.0)
    promised = (float(residual @ residual) - most) / max(1, base.count - base.jacobian.shape[1])
    most_left = problem.rules.formula.hopeful * left(problem, base)
    return bool(promised - noise_bound(problem, base) < most_left)


def left(problem: Problem, fit: Fit) -> float:
    """Chi-square per degree of freedom beyond what noise may leave."""
    return max(fit.reduced - noise_bound(problem, fit), 0.0)


def _plain(trial: Trial) -> Trial:
    """A trial without the variant that told formulas apart."""
    point = trial.fit.point
    term = replace(point.terms[-1], variant="")
    return replace(trial, fit=replace(trial.fit, point=replace(point, terms=(*point.terms[:-1], term))))
