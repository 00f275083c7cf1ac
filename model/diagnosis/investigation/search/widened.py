"""Wider forms of the laws found: valves and stops that differ in the two directions.

Two laws of one element are fitted as a sum of forces, but interact: a damper that is harder in extension and blows off
does so from a harder slope.  Their sum fits nearly as well with biased values and too small stated errors.  So a law's
wider form competes with the next finding, and where it cannot be distinguished from the narrow one, the difference of
their values is part of the uncertainty.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import finished, refreshed
from sprung.model.diagnosis.fit.optimise import Fit, falling, try_optimise
from sprung.model.diagnosis.investigation.search.minor import untried
from sprung.model.diagnosis.investigation.state import Investigation, TriedWider, WidenedFit
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.along_measured import MeasuredMotion
from sprung.model.diagnosis.selection.compete import (
    Trial,
    by_evidence,
    compete,
    cost,
    gain_over,
    noise_bound,
    shortlist,
)
from sprung.model.diagnosis.selection.evidence import occam_cost
from sprung.model.diagnosis.selection.matched import matched_starts
from sprung.model.diagnosis.selection.plausible import doubt
from sprung.model.diagnosis.selection.starts import wider_starts
from sprung.model.laws import ElementLaw
from sprung.model.signals import FloatArray

_FIRST, _MORE, _ROUNDS = 3, 10, 3  # iterations of a start, and of the best one in a round; rounds while it falls


def with_wider_tried(state: Investigation) -> Investigation:
    """The investigation with the laws found so far tried in their wider forms, if that has not been done."""
    if state.wider is not None and state.wider.of is state.fit:
        return state
    return replace(state, wider=TriedWider(state.fit, _best_widened(state)))


def best_wider(state: Investigation) -> WidenedFit | None:
    """The best wider form of a law of the present fit, if forms were tried and a law has one."""
    known = state.wider
    return known.best if known is not None and known.of is state.fit else None


def _best_widened(state: Investigation) -> WidenedFit | None:
    """The wider form of highest evidence among the laws found so far; None: no law has one."""
    if state.problem.process_noise:
        return None
    tried = [(index, _widened(state, index), None) for index in range(state.given, len(state.fit.point.terms))]
    fits = [(index, fit, rival) for index, fit, rival in (*tried, *_rivals_widened(state)) if fit is not None]
    rules = state.problem.rules.evidence
    least = min((fit.reduced for _, fit, _ in fits), default=1.0)
    # if one leaves less than the noise level estimated with the narrow form, that smaller level counts
    quiet = rules.quiet * (least if least < rules.quiet else 1.0)
    judged = [_judged(state, index, fit, quiet, rival) for index, fit, rival in fits]
    return max(judged, key=lambda one: one.evidence, default=None)


def is_better(state: Investigation, wide: WidenedFit, trials: list[Trial]) -> bool:
    """Whether the wider form of a law found explains more than the best of the next trials."""
    if wide.evidence <= 0 or doubt(wide.fit, wide.fit.point.terms[wide.index], state.options.rules.plausible):
        return False
    if trials and trials[0].named and trials[0].evidence > wide.evidence:
        return False
    if trials and not trials[0].named and trials[0].explains > state.options.rules.selection.unnamed_ratio * wide.gain:
        return False
    return not state.refutes(wide.fit)


def rivals_of_wider(state: Investigation, wide: WidenedFit) -> list[Candidate]:
    """Laws that may explain as much beside the narrow form at its element as the wider form does.

    Plain friction beside a valve is nearly the force of a friction that changes with the rate.  Scores of such laws are
    far below those elsewhere, since the narrow law and the damper have absorbed most of what they would explain.
    """
    place, options = wide.fit.point.terms[wide.index].location, state.options
    here = [one for one in untried(state, state.last.candidates) if one.location == place and one.term.law.named]
    alone = replace(state.last, candidates=tuple(here))
    close = shortlist(alone, options.rules.acceptance.alpha, options.multiplicity, options.rules)
    starts = [(one, matched_starts(state.problem, state.fit, wide.fit, wide.index, one)) for one in close]
    return [*close, *(replace(one, start=start) for one, more in starts for start in more)]


def adopt_wider(state: Investigation, wide: WidenedFit) -> Investigation:
    """The investigation with a law that was found, or a rival in its place, in its wider form."""
    if wide.instead is not None:
        *before, last = state.found
        others = tuple(trial for trial in last.trials if trial is not wide.instead)
        evidence, gain = last.trial.evidence + wide.evidence, last.trial.gain + wide.gain
        trial = replace(wide.instead, evidence=evidence, gain=gain, reduction=last.trial.reduction + wide.fall)
        swapped = replace(last, trial=trial, trials=(last.trial, *others), runner_up=last.trial)
        state = replace(state, found=(*before, swapped))
    return with_model(state, wide.fit)


def with_model(state: Investigation, fit: Fit) -> Investigation:
    """The investigation with another fit as its model, noise levels estimated and the residual screened anew."""
    problem, fit = finished(*refreshed(state.problem, fit))
    last = screen(problem, fit, state.problem.system.catalogue, state.options.project)
    return replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise), last=last)


def form_covariance(state: Investigation) -> FloatArray:
    """Covariance of parameters and laws from the choice between narrow and wider form, (P + p, P + p).

    Bayesian model averaging (Hoeting et al. 1999) over the present form and the best wider one, with equal prior odds.
    """
    fit = state.fit
    nothing = np.zeros_like(fit.covariance)
    wide = best_wider(with_wider_tried(state)) if share_an_element(state) else None
    if wide is None or wide.instead is not None:
        return nothing
    rules = state.problem.rules.evidence
    evidence = wide.evidence + rules.rarity * wide.fit.point.terms[wide.index].law.prior_cost
    odds = float(np.exp(np.clip(evidence / 2, -50.0, 50.0)))
    share = odds / (1 + odds)
    pairs = zip(fit.point.terms, wide.fit.point.terms, strict=True)
    moved = [np.subtract(wider.parameters[: len(own.parameters)], own.parameters) for own, wider in pairs]
    between = np.concatenate([wide.fit.point.theta - fit.point.theta, *moved])
    return share * (1 - share) * np.outer(between, between) if np.all(np.isfinite(between)) else nothing


def share_an_element(state: Investigation) -> bool:
    """Whether several laws were found at one element: their forces may interact."""
    places = [found.trial.term.location for found in state.found if isinstance(found.trial.term.law, ElementLaw)]
    return len(set(places)) < len(places)


def with_wider_rivals(state: Investigation, trials: list[Trial]) -> list[Trial]:
    """Trials with the wider forms of the best of them at elements where a law was found already.

    Beside a stop, friction fits valves that differ in the two directions better than symmetric valves do.
    """
    taken = {found.trial.term.location for found in state.found}
    beside = [trial for trial in trials if trial.finished and trial.evidence > 0 and trial.term.location in taken]
    candidates: list[Candidate] = []
    for trial in beside:
        starts = list(wider_starts(trial.fit, len(trial.fit.point.terms) - 1))
        if starts and len({candidate.effect for candidate in candidates}) < state.options.rules.selection.wider:
            candidates += [replace(trial.candidate, term=start.terms[-1], start=start) for start in starts]
    if not candidates or state.problem.process_noise:
        return trials
    return by_evidence(state.problem, state.fit, [*trials, *compete(state.problem, state.fit, candidates)])


def _widened(state: Investigation, index: int) -> Fit | None:
    """The fit with one of its laws in its wider form, from the best of several starts."""
    problem, base = state.problem, state.fit
    starts = list(wider_starts(base, index))
    if starts and base.reduced > noise_bound(problem, base):  # what it leaves is no noise: its motion may be far off
        measured = MeasuredMotion.of(problem, base)
        along = None if measured is None else measured.wider(index)
        starts += [along] if along is not None else []
    return _from_best(state, starts)


def _rivals_widened(state: Investigation) -> list[tuple[int, Fit | None, Trial | None]]:
    """The model with the best rival of the last finding in its place, in its wider form.

    Of two laws in their narrow forms the wrong one may be nearer to a third that only the other one can take: a power
    of the rate is nearer to a friction that grows with the rate than a constant friction is.
    """
    if not state.found:
        return []
    last, index = state.found[-1].trial, len(state.fit.point.terms) - 1
    rivals = [
        trial
        for trial in state.found[-1].trials
        if trial.finished
        and trial.term.location == last.term.location
        and trial.term.law.name != last.term.law.name
        and len(trial.fit.point.terms) == index + 1
        and any(wider_starts(trial.fit, index))
    ]
    if not rivals:
        return []
    best = max(rivals, key=lambda trial: trial.evidence)
    return [(index, _from_best(state, list(wider_starts(best.fit, index))), best)]


def _from_best(state: Investigation, starts: list[Point]) -> Fit | None:
    """The fit from the best of several starts; None where all diverge."""
    problem, whitener = state.problem, state.fit.whitener
    tried = (try_optimise(problem, start, _FIRST, whitener) for start in starts)
    best = min((fit for fit in tried if fit is not None), key=lambda fit: fit.chi_square, default=None)
    return None if best is None else falling(problem, best, _MORE, _ROUNDS)


def _judged(state: Investigation, index: int, fit: Fit, quiet: float, rival: Trial | None) -> WidenedFit:
    """Evidence of the wider form over the present fit."""
    gain, fall = gain_over(state.problem, state.fit, fit, quiet)
    more = _cost(state, fit, index) if rival is None else _cost_instead(state, fit, index)
    return WidenedFit(fit, index, fall, gain, gain - more, rival)


def _cost_instead(state: Investigation, fit: Fit, index: int) -> float:
    """Cost in evidence of the parameters of a wider law over those of the law in whose place it is."""
    rules = state.problem.rules.evidence
    return cost(fit, rules, index) - cost(state.fit, rules, index)


def _cost(state: Investigation, fit: Fit, index: int) -> float:
    """Cost in evidence of the additional parameters of a widened law."""
    term, place = fit.point.terms[index], fit.place(index)
    more = slice(len(state.fit.point.terms[index].parameters), None)
    determined = fit.covariance[place, place][more, more] / np.outer(term.slopes[more], term.slopes[more])
    logs = [spec.log for spec in term.law.parameters[more]]
    rules = state.problem.rules.evidence
    return occam_cost(logs, term.scales[more], determined, rules) + rules.rarity * term.law.prior_cost
