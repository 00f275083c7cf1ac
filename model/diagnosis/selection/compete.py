"""Model selection: full fits of the candidates with the highest scores, compared by evidence, one finding at a time.

`evidence` holds the formulas.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.chunks import WORKERS, Piece, Result, share
from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.misfit import is_gross
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.rules import RULES, EvidenceRules, Rules, SelectionRules
from sprung.model.diagnosis.screening.score import Candidate, Screening
from sprung.model.diagnosis.selection.along_measured import SHARPENED, MeasuredMotion
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

_STEPS = 6  # from a start along the measured motion
_FINISHING = 10  # of a first fit that is finished
_PROMISED = 3  # times what a refused step promised, the most that further ones bring


@dataclass(frozen=True)
class Trial:
    """A candidate with all parameters refitted beside it."""

    candidate: Candidate
    fit: Fit
    gain: float  # twice the log-likelihood ratio against the model without it
    reduction: float  # of chi-square, or of the power of unmeasured forces
    evidence: float  # gain less what its parameters cost
    freedom: int  # parameters of the law and states it adds
    finished: bool = True
    gained: float = np.inf  # evidence, by further iterations
    compared: bool = True  # False: the model without it diverges, and the gain is no more than a rank

    @property
    def term(self) -> Term:
        return self.fit.point.terms[-1]

    @property
    def explains(self) -> float:
        """The part of the residual it explains: likelihood gain, or power of unmeasured forces."""
        return self.reduction if self.fit.noise.process_noise else self.gain

    @property
    def named(self) -> bool:
        return self.term.law.named

    def delta_bic(self) -> float | None:
        """BIC with the candidate less BIC without; None where the model without it diverges."""
        return None if not self.compared else bic(self.gain, len(self.term.parameters), self.fit.count)


def shortlist(
    screening: Screening,
    alpha: float,
    multiplicity: bool = True,
    rules: Rules = RULES,
    *,
    gross: bool = False,
    whole: float = 1.0,
) -> list[Candidate]:
    """Significant candidates that could be the best, one per law, place and variant; no faults of input channels.

    whole: length of the recording over that of its fitted part.  Significant is what would be so on the whole recording
    if the rest of it showed as much: whether it does is asked of the rest, once it is fitted.

    gross: whether the model's motion is far from the measured one.  Scores then indicate the place, but not which of
    an element's laws acts there: a law that yields permanently has little effect along a motion without yielding.
    """
    tests = {family: screening.tried(family) if multiplicity else 1 for family in screening.tests}
    good = [h for h in screening.candidates if chance(whole * h.score, h.freedom, tests[h.family]) <= alpha]
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
    known: Sequence[Trial] = (),
) -> list[Trial]:
    """Fits of the candidates beside the present model, best evidence first.

    known: trials of an earlier competition beside the same model, which are not fitted once more.
    Laws with names come first: an unnamed force is only fitted where it could still explain enough more than they do.
    """
    places = sorted({candidate.location for candidate in candidates})
    progress(f"fitting {len(candidates)} candidates at {', '.join(places)}")
    trials = _initial_fits(problem, base, candidates, known)
    if not trials:
        return []
    leading, behind = _leading(problem, trials)
    named = _converged_fits(problem, base, [trial for trial in leading if trial.named])
    unnamed = [trial for trial in leading if not trial.named]
    if any(_could_lead(problem, trial.candidate, named) for trial in unnamed):
        unnamed = _converged_fits(problem, base, unnamed)
    else:
        unnamed = [replace(trial, finished=False) for trial in unnamed]
    return _with_unconverged_refitted(problem, base, by_evidence(problem, base, [*named, *unnamed, *behind]))


def _initial_fits(problem: Problem, base: Fit, candidates: list[Candidate], known: Sequence[Trial]) -> list[Trial]:
    """First fits of the candidates, best evidence first."""
    fitted = {trial.candidate.term.key: trial.fit for trial in known}
    screened = problem.rules.screening
    most = max((candidate.strength(screened) for candidate in candidates), default=0.0)
    again = problem.rules.selection.again * most
    measured = MeasuredMotion.of(problem, base) if is_gross(problem, base) else None

    def initial_fit(own: Problem, candidate: Candidate) -> Trial | None:
        if candidate.term.key in fitted:
            return _trial(own, base, candidate, fitted[candidate.term.key])
        return _initial_fit(own, base, candidate, candidate.strength(screened) > again, measured)

    def fits(chosen: list[Candidate]) -> list[Trial]:
        return [trial for trial in _in_parallel(initial_fit, problem, chosen) if trial is not None]

    trials = fits([candidate for candidate in candidates if candidate.term.law.named])
    unnamed = [candidate for candidate in candidates if not candidate.term.law.named]
    trials += fits([candidate for candidate in unnamed if _could_lead(problem, candidate, trials)])
    return by_evidence(problem, base, trials)


def _leading(problem: Problem, trials: list[Trial]) -> tuple[list[Trial], list[Trial]]:
    """The trials, best first, whose fits go on, and the others; of these the close ones count as they are.

    Of fits that are far behind, those go on that steps like their last one would bring to the lead, or what a refused
    one promised: from some starts the first steps are too few for their evidence to tell, and later ones are shorter.
    """
    rules, best, least = problem.rules.selection, trials[0].evidence, trials[0].fit.chi_square
    leading, behind = [], []
    for rank, trial in enumerate(trials):
        far = not problem.process_noise and trial.evidence <= best - rules.near
        close = rank < rules.finished and not (far and trial.evidence <= best - rules.near_share * abs(best))
        reach = (_PROMISED if trial.fit.refused else _FINISHING) * trial.fit.left
        falling = trial.fit.converged or trial.fit.chi_square - reach < least
        if (falling and rank < rules.last) or (close and (falling or not far)):
            leading.append(trial)
        else:
            behind.append(replace(trial, finished=close))
    return leading, behind


def _converged_fits(problem: Problem, base: Fit, trials: list[Trial]) -> list[Trial]:
    """The trials fitted to convergence, in parallel."""
    return _in_parallel(lambda own, trial: _converged_fit(own, base, trial), problem, trials)


def _with_unconverged_refitted(problem: Problem, base: Fit, trials: list[Trial]) -> list[Trial]:
    """Trials by evidence, after further iterations of unconverged fits that could still take the lead.

    Of a fit whose last iterations gained less than it is behind, later ones gain less still.
    """
    for _ in range(problem.rules.selection.settling):
        best = trials[0].evidence
        unsettled = [t for t in trials if t.finished and not t.fit.converged and t.gained > max(0.0, best - t.evidence)]
        falling = [t for t in unsettled if t.evidence + t.fit.left / t.fit.grain > best]
        if not falling:
            break
        others = [t for t in trials if all(t is not one for one in falling)]
        trials = by_evidence(problem, base, [*_converged_fits(problem, base, falling), *others])
    return trials


def _in_parallel(work: Callable[[Problem, Piece], Result], problem: Problem, pieces: Sequence[Piece]) -> list[Result]:
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
    """The best trial with another law, at the same place before others; if there is none, candidates are fitted."""
    rivals = [t for t in tried if t.term.law.name != chosen.term.law.name and t.gain > 0]
    if rivals:
        return max(rivals, key=lambda t: (t.term.location == chosen.term.location, t.evidence))
    fitted = {t.candidate.term.key for t in tried}
    rules = problem.rules
    others = [h for h in candidates if h.effect != chosen.candidate.effect and h.score > 0 and h.term.key not in fitted]
    for candidate in sorted(others, key=lambda h: h.strength(rules.screening), reverse=True)[: rules.selection.further]:
        trial = _initial_fit(problem, base, candidate)
        if trial is not None and trial.gain > 0:
            return replace(trial, finished=False)
    return None


def _initial_fit(
    problem: Problem, base: Fit, candidate: Candidate, again: bool = False, measured: MeasuredMotion | None = None
) -> Trial | None:
    """A few iterations of a candidate from each of its starts, and the best of these fits; None if all diverge.

    again: whether a law that has look-alikes among its own values is started from these too, if its first fits leave
    more than noise.  measured: the model along the measured motion, for one more start.
    """
    exact, problem = problem, replace(problem, newton_allowed=False)
    starts = starts_of(problem, base, candidate)
    tried = [t for t in (_try(problem, base, candidate, start, 3) for start in starts) if t is not None]
    along = [] if measured is None else measured.starts(candidate)
    steps = _STEPS if candidate.term.law.corner is None else SHARPENED
    tried += [t for t in (_try(exact, base, candidate, start, steps) for start in along) if t is not None]
    best = max(tried, key=lambda t: t.evidence, default=None)
    if again and (best is None or _leaves_much(problem, best)):
        others = (_try(problem, base, candidate, start, 3) for start in alike_starts(base, candidate))
        best = max((t for t in (best, *others) if t is not None), key=lambda t: t.evidence, default=None)
    return best


def _leaves_much(problem: Problem, trial: Trial) -> bool:
    """Whether a fit leaves more than noise or, where the noise of forces is fitted too, has not converged."""
    if problem.process_noise:
        return not trial.fit.converged
    return trial.fit.reduced > noise_bound(problem, trial.fit)


def noise_bound(problem: Problem, fit: Fit) -> float:
    """Chi-square per degree of freedom that noise alone may leave."""
    return 1 + problem.rules.selection.chance * float(np.sqrt(2 / fit.count))


def _could_lead(problem: Problem, unnamed: Candidate, named: list[Trial]) -> bool:
    """Whether an unnamed force could explain sufficiently more than the named laws.

    It cannot where the best of several laws leaves only noise and explains more than the score of the force promises.
    """
    if problem.process_noise or len(named) < 2:
        return True
    best = max(named, key=lambda trial: trial.reduction)
    quiet = problem.rules.evidence.quiet <= best.fit.reduced <= noise_bound(problem, best.fit)
    return unnamed.score > best.reduction or not quiet


def by_evidence(problem: Problem, base: Fit, trials: list[Trial]) -> list[Trial]:
    """Trials by evidence.  If one leaves less than the noise level estimated without it, its level counts for all."""
    rules = problem.rules.evidence
    least = min((t.fit.reduced for t in trials), default=1.0)
    if least < rules.quiet and not problem.process_noise:
        again = [_trial(problem, base, t.candidate, t.fit, rules.quiet * least) for t in trials]
        trials = [replace(new, finished=t.finished, gained=t.gained) for new, t in zip(again, trials, strict=True)]
    if not problem.process_noise:
        gains = monotone_gains([t.gain for t in trials], [t.fit.chi_square for t in trials], rules)
        trials = [
            replace(t, gain=gain, evidence=t.evidence - (t.gain - gain)) for t, gain in zip(trials, gains, strict=True)
        ]
    return sorted(trials, key=lambda t: -t.evidence)


def _try(problem: Problem, base: Fit, candidate: Candidate, start: Point, iterations: int) -> Trial | None:
    fit = try_optimise(problem, start, iterations, base.whitener)
    return None if fit is None else _trial(problem, base, candidate, fit)


def _converged_fit(problem: Problem, base: Fit, trial: Trial) -> Trial:
    """A trial fitted to convergence; with measured forces their noise level is estimated anew, now beside the law."""
    if trial.fit.converged and not problem.process_noise:
        return trial
    finished = _try(problem, base, trial.candidate, trial.fit.point, _FINISHING) or trial
    if problem.process_noise and finished.fit.deviance <= base.deviance:
        _, fit = refreshed(problem, finished.fit)
        finished = _trial(problem, base, trial.candidate, fit)
    before = _trial(problem, base, trial.candidate, trial.fit)  # its evidence may know a lower noise level
    return replace(finished, gained=finished.evidence - before.evidence)


def _trial(problem: Problem, base: Fit, candidate: Candidate, fit: Fit, quiet: float | None = None) -> Trial:
    """A fit with its evidence over the base.  quiet: level below which blocks are no evidence; None: by the rules."""
    gain, reduction = gain_over(problem, base, fit, problem.rules.evidence.quiet if quiet is None else quiet)
    freedom = len(fit.point.terms[-1].parameters) + len(fit.point.state) - len(base.point.state)
    return Trial(candidate, fit, gain, reduction, gain - cost(fit, problem.rules.evidence), freedom)


def gain_over(problem: Problem, base: Fit, fit: Fit, quiet: float) -> tuple[float, float]:
    """Twice the log-likelihood ratio of a fit over the base; reduction of chi-square or of unmeasured forces."""
    rules, sensors = problem.rules.evidence, len(problem.sensors)
    if problem.process_noise:  # candidates differ in the noise level of the forces
        gain = process_gain(base.residual, fit.residual, sensors, (base.log_det, fit.log_det), rules)
        return gain, float(np.sum(base.noise.force**2) - np.sum(fit.noise.force**2))
    reduction = base.chi_square - fit.chi_square
    return min(reduction, profile_gain(base.residual, fit.residual, sensors, quiet, rules)), reduction


def gain_together(problem: Problem, base: Fit, terms: Sequence[Term], iterations: int) -> float:
    """Twice the log ratio of posteriors of several terms with priors over the base; -inf where their fit diverges."""
    point = replace(base.point, terms=(*base.point.terms, *terms))
    fit = try_optimise(problem, point, iterations, base.whitener)
    if fit is None:
        return -np.inf
    gain, _ = gain_over(problem, base, fit, problem.rules.evidence.quiet)
    fitted = fit.point.terms[len(base.point.terms) :]
    return gain - sum(float(np.sum(term.prior_deviations**2)) for term in fitted)


def preferred(trials: list[Trial], rules: SelectionRules = RULES.selection) -> list[Trial]:
    """Trials by evidence, but an unnamed force leads only if it explains far more than every named candidate.

    More is enough where its evidence is plainly higher: the best of the laws is then not the true one.
    """
    if not trials or trials[0].named:
        return trials
    named = [t for t in trials if t.named]
    if not named:
        return trials
    plainly = trials[0].evidence > named[0].evidence + rules.unnamed_margin
    ratio = rules.unnamed_sure if plainly else rules.unnamed_ratio
    if trials[0].explains < ratio * named[0].explains:
        return [named[0], *[t for t in trials if t is not named[0]]]
    return trials


def unnamed_alike(trials: Sequence[Trial], law: Trial, margin: float, rules: EvidenceRules) -> list[Trial]:
    """Unnamed forces at a law's place, no more flexible than it, whose fits do not speak less for them by the margin.

    That such a force is rare before a recording is no reason to call the law determined by the recording.
    """

    def of_recording(trial: Trial) -> float:
        return trial.evidence + rules.rarity * trial.term.law.prior_cost

    return [
        t
        for t in trials
        if not t.named
        and t.finished
        and t.term.location == law.term.location
        and t.freedom <= law.freedom
        and of_recording(t) > of_recording(law) - margin
    ]


def cost(fit: Fit, rules: EvidenceRules = RULES.evidence, index: int = -1) -> float:
    """Cost in evidence of a law's parameters and of its rarity; index: of the term, by default the last."""
    term, place = fit.point.terms[index], fit.place(index)
    block = fit.covariance[place, place]
    if not term.law.named:  # amplitudes of one curve, correlated by convention: each counts by itself
        block = np.diag(np.diag(block))
    logs = [spec.log for spec in term.law.parameters]
    total = occam_cost(logs, term.scales, block / np.outer(term.slopes, term.slopes), rules)
    for spec, scale, value in zip(term.law.parameters, term.scales, term.parameters, strict=False):
        total += unusual_cost(value / scale, spec.usual, rules)
    return total + rules.rarity * term.law.prior_cost
