"""Which candidate, if any: full fits of the best screened ones, compared by evidence, one finding after the other.

What a fit is worth and what its parameters cost: `evidence`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.chunks import WORKERS, Piece, Result, share
from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.rules import RULES, EvidenceRules, Rules, SelectionRules
from sprung.model.diagnosis.screening.score import Candidate, Screening
from sprung.model.diagnosis.selection.evidence import (
    bic,
    chance,
    monotone_gains,
    occam_cost,
    process_gain,
    profile_gain,
    unusual_cost,
)
from sprung.model.diagnosis.selection.starts import alike_starts, starts_of


@dataclass(frozen=True)
class Trial:
    """A candidate with everything refitted around it."""

    candidate: Candidate
    fit: Fit
    gain: float  # twice the log-likelihood ratio against the model without it
    worth: float  # of what was missing: its fall of chi-square, or of the power of forces that nobody measured
    evidence: float  # gain less what its parameters cost
    freedom: int  # parameters of the law, and states that it brings
    finished: bool = True

    @property
    def term(self) -> Term:
        return self.fit.point.terms[-1]

    @property
    def explains(self) -> float:
        """How much of what was missing: evidence, or power of forces that nobody measured."""
        return self.worth if self.fit.noise.process_noise else self.gain

    @property
    def named(self) -> bool:
        return self.term.law.named

    def p_value(self, tests: int) -> float:
        """Chance of such a gain among so many candidates, noise levels unknown."""
        return chance(self.gain, self.freedom, tests)

    def delta_bic(self) -> float:
        """BIC with the candidate less BIC without."""
        return bic(self.gain, len(self.term.parameters), self.fit.count)


def shortlist(
    screening: Screening,
    alpha: float,
    multiplicity: bool = True,
    rules: Rules = RULES,
    *,
    gross: bool = False,
) -> list[Candidate]:
    """Significant candidates that could be the best, one per law, place and variant; none of input channels.

    gross: whether the motion that they were scored along is far from the measured one.  Then scores tell the place, but
    not which of an element's laws acts there: what yields all the time is hardly seen along a motion that does not.
    """
    good = [h for h in screening.candidates if (screening.p_value(h) if multiplicity else h.p_single) <= alpha]
    if not good:
        return []
    good.sort(key=lambda h: h.strength(rules.screening), reverse=True)
    top, screened, chosen_by = good[0].strength(rules.screening), rules.screening, rules.selection
    place = good[0].location
    chosen: list[Candidate] = []
    unnamed: dict[str, int] = {}
    for candidate in good:
        s = candidate.strength(screened)
        share = chosen_by.close if candidate.location == place else chosen_by.close_elsewhere
        known = gross and candidate.location == place and candidate.term.law.named and evaluated_in_time(candidate.term)
        if s < share * top and s < top - chosen_by.near and not known:
            continue
        if not candidate.term.law.named:
            unnamed[candidate.location] = unnamed.get(candidate.location, 0) + 1
            if unnamed[candidate.location] > chosen_by.unnamed:
                continue
        chosen.append(candidate)
        if len(chosen) >= (chosen_by.most_gross if gross else chosen_by.most):
            break
    return chosen


def compete(
    problem: Problem,
    base: Fit,
    candidates: list[Candidate],
    progress: Callable[[str], None] = lambda text: None,
) -> list[Trial]:
    """Fits of the candidates around the present model, best evidence first."""
    rules = problem.rules.selection
    places = sorted({candidate.location for candidate in candidates})
    progress(f"fitting {len(candidates)} candidates at {', '.join(places)}")

    screened = problem.rules.screening
    again = rules.again * max((candidate.strength(screened) for candidate in candidates), default=0.0)

    def begun(chosen: list[Candidate]) -> list[Trial]:
        tried = _shared(
            lambda own, candidate: _begun(own, base, candidate, candidate.strength(screened) > again), problem, chosen
        )
        return [trial for trial in tried if trial is not None]

    def finished(chosen: list[Trial]) -> list[Trial]:
        return _shared(lambda own, trial: _finished(own, base, trial), problem, chosen)

    trials = begun([candidate for candidate in candidates if candidate.term.law.named])
    trials += begun(
        [
            candidate
            for candidate in candidates
            if not candidate.term.law.named and _may_lead(problem, candidate, trials)
        ]
    )
    trials = graded(problem, base, trials)
    if not trials:
        return []
    best = trials[0].evidence

    def close(rank: int, trial: Trial) -> bool:
        near = problem.process_noise or trial.evidence > best - max(rules.near, rules.near_share * abs(best))
        return rank < rules.last or (rank < rules.finished and near)

    leading = [trial for rank, trial in enumerate(trials) if close(rank, trial)]
    behind = [replace(trial, finished=False) for rank, trial in enumerate(trials) if not close(rank, trial)]
    named = finished([trial for trial in leading if trial.named])
    unnamed = [trial for trial in leading if not trial.named]
    if not any(_may_lead(problem, trial.candidate, named) for trial in unnamed):
        all_trials = [*named, *(replace(trial, finished=False) for trial in unnamed), *behind]
    else:
        all_trials = [*named, *finished(unnamed), *behind]
    return _settled(problem, base, graded(problem, base, all_trials))


def _settled(problem: Problem, base: Fit, trials: list[Trial]) -> list[Trial]:
    """Trials by evidence, none of which could lead if only it were fitted on: a fit that still falls is no gain."""
    stuck: list[Fit] = []  # that were fitted on and got no further
    for _ in range(problem.rules.selection.settling):
        best = trials[0].evidence
        unsettled = [t for t in trials if t.finished and not t.fit.converged and all(t.fit is not one for one in stuck)]
        falling = [t for t in unsettled if t.evidence + t.fit.left / t.fit.grain > best]
        if not falling:
            break
        others = [t for t in trials if all(t is not one for one in falling)]
        again = _shared(lambda own, trial: _finished(own, base, trial), problem, falling)
        stuck += [new.fit for old, new in zip(falling, again, strict=True) if new.evidence <= old.evidence]
        trials = graded(problem, base, [*again, *others])
    return trials


def _shared(work: Callable[[Problem, Piece], Result], problem: Problem, pieces: Sequence[Piece]) -> list[Result]:
    """Pieces of work on one problem, shared among threads, each with a budget of its own."""
    if problem.work is None:
        return share(lambda piece: work(problem, piece), pieces, WORKERS)
    budgets = problem.work.apart(len(pieces))
    own = [(replace(problem, work=budget), piece) for budget, piece in zip(budgets, pieces, strict=True)]
    results = share(lambda pair: work(*pair), own, WORKERS)
    problem.work.gather(budgets)
    return results


def runner_up(
    problem: Problem, base: Fit, candidates: list[Candidate], chosen: Trial, tried: list[Trial]
) -> Trial | None:
    """The best candidate with another law, at the same place before others; a candidate is fitted where none was."""
    rivals = [t for t in tried if t.term.law.name != chosen.term.law.name and t.gain > 0]
    if rivals:
        return max(rivals, key=lambda t: (t.term.location == chosen.term.location, t.evidence))
    fitted = {t.candidate.term.key for t in tried}
    rules = problem.rules
    others = [h for h in candidates if h.effect != chosen.candidate.effect and h.score > 0 and h.term.key not in fitted]
    for candidate in sorted(others, key=lambda h: h.strength(rules.screening), reverse=True)[: rules.selection.further]:
        trial = _begun(problem, base, candidate)
        if trial is not None and trial.gain > 0:
            return replace(trial, finished=False)
    return None


def _begun(problem: Problem, base: Fit, candidate: Candidate, again: bool = False) -> Trial | None:
    """A candidate fitted far enough to see what it is worth, from the best of several starts.

    again: whether a law with look-alikes of its own starts from those too, where its first fits leave much.
    """
    problem = replace(problem, newton_allowed=False)
    starts = starts_of(problem, base, candidate)
    tried = [t for t in (_try(problem, base, candidate, start, 3) for start in starts) if t is not None]
    best = max(tried, key=lambda t: t.evidence, default=None)
    if again and (best is None or _leaves_much(problem, best)):
        others = (_try(problem, base, candidate, start, 3) for start in alike_starts(base, candidate))
        best = max((t for t in (best, *others) if t is not None), key=lambda t: t.evidence, default=None)
    return best


def _leaves_much(problem: Problem, trial: Trial) -> bool:
    """Whether a fit is no end: more than noise is left, or, where noise is what is fitted, it still falls."""
    if problem.process_noise:
        return not trial.fit.converged
    return trial.fit.reduced > noise_bound(problem, trial.fit)


def noise_bound(problem: Problem, fit: Fit) -> float:
    """Chi-square per degree of freedom that noise alone may leave."""
    return 1 + problem.rules.selection.chance * float(np.sqrt(2 / fit.count))


def _may_lead(problem: Problem, unnamed: Candidate, named: list[Trial]) -> bool:
    """Whether an unnamed force could explain enough more than named laws: not where they leave noise and more than
    it promises is explained.  With one law alone it stays as what that one was chosen before."""
    if problem.process_noise or len(named) < 2:
        return True
    best = max(named, key=lambda trial: trial.worth)
    quiet = problem.rules.evidence.quiet <= best.fit.reduced <= noise_bound(problem, best.fit)
    return unnamed.score > best.worth or not quiet


def graded(problem: Problem, base: Fit, trials: list[Trial]) -> list[Trial]:
    """Trials by evidence; where one leaves less than the noise that the base's misfit was taken for, by its own."""
    rules = problem.rules.evidence
    least = min((t.fit.reduced for t in trials), default=1.0)
    if least < rules.quiet and not problem.process_noise:
        again = [_judged(problem, base, t.candidate, t.fit, rules.quiet * least) for t in trials]
        trials = [replace(new, finished=t.finished) for new, t in zip(again, trials, strict=True)]
    if not problem.process_noise:
        gains = monotone_gains([t.gain for t in trials], [t.fit.chi_square for t in trials], rules)
        trials = [
            replace(t, gain=gain, evidence=t.evidence - (t.gain - gain)) for t, gain in zip(trials, gains, strict=True)
        ]
    return sorted(trials, key=lambda t: -t.evidence)


def _try(problem: Problem, base: Fit, candidate: Candidate, start: Point, iterations: int) -> Trial | None:
    fit = try_optimise(problem, start, iterations, base.whitener)
    return None if fit is None else _judged(problem, base, candidate, fit)


def _finished(problem: Problem, base: Fit, trial: Trial) -> Trial:
    """A trial fitted to the end, measured forces with their noise beside it: without the law that stood for it."""
    if trial.fit.converged and not problem.process_noise:
        return trial
    finished = _try(problem, base, trial.candidate, trial.fit.point, 10) or trial
    if not problem.process_noise or finished.fit.deviance > base.deviance:
        return finished
    _, fit = refreshed(problem, finished.fit)
    return _judged(problem, base, trial.candidate, fit)


def _judged(problem: Problem, base: Fit, candidate: Candidate, fit: Fit, quiet: float | None = None) -> Trial:
    rules = problem.rules.evidence
    quiet = rules.quiet if quiet is None else quiet
    sensors = len(problem.sensors)
    if problem.process_noise:  # how noisy the forces are is what candidates differ in
        gain = process_gain(base.residual, fit.residual, sensors, (base.log_det, fit.log_det), rules)
        worth = float(np.sum(base.noise.force**2) - np.sum(fit.noise.force**2))
    else:
        worth = base.chi_square - fit.chi_square
        gain = min(worth, profile_gain(base.residual, fit.residual, sensors, quiet, rules))
    dear = cost(fit, rules)
    freedom = len(candidate.term.parameters) + len(fit.point.state) - len(base.point.state)
    return Trial(candidate, fit, gain, worth, gain - dear, freedom)


def preferred(trials: list[Trial], rules: SelectionRules = RULES.selection) -> list[Trial]:
    """Trials by evidence, but an unnamed force leads only if it explains far more than every named candidate."""
    if not trials or trials[0].named:
        return trials
    named = [t for t in trials if t.named]
    if named and trials[0].explains < rules.unnamed_ratio * named[0].explains:
        return [named[0], *[t for t in trials if t is not named[0]]]
    return trials


def cost(fit: Fit, rules: EvidenceRules = RULES.evidence, index: int = -1) -> float:
    """What a law, the last by default, costs in evidence: by its parameters and its rarity."""
    term, place = fit.point.terms[index], fit.place(index)
    block = fit.covariance[place, place]
    if not term.law.named:  # amplitudes of one curve, which differ from each other's by convention: each by itself
        block = np.diag(np.diag(block))
    logs = [spec.log for spec in term.law.parameters]
    total = occam_cost(logs, term.scales, block / np.outer(term.slopes, term.slopes), rules)
    for spec, scale, value in zip(term.law.parameters, term.scales, term.parameters, strict=False):
        total += unusual_cost(value / scale, spec.usual, rules)
    return total + rules.rarity * term.law.prior_cost
