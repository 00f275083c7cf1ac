"""The same force in other words: a law that is restated as another one, beside a likelier spring.

A spring with a clearance, and stops without a spring between them, are the same curve.  Beside other laws at the same
element, a stop may be found first, while the spring still stands for some of what these do; once they are found as
well, nothing is left of the spring, and only the words are wrong.  A spring carries the load, so the curve of a spring
near nominal is the likelier one: both are compared by what they leave, by their parameters, and by how far springs and
dampers are from nominal under the prior of the fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.search.widened import with_model
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time, typical_scales
from sprung.model.diagnosis.selection.compete import Trial, cost
from sprung.model.diagnosis.selection.evidence import profile_gain
from sprung.model.diagnosis.selection.starts import seen
from sprung.model.laws import ElementLaw, SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.base import Restatement

_STEPS = 10  # of a fit in other words


def restated(state: Investigation) -> Investigation:
    """The investigation with laws restated as others that say the same of a likelier spring and damper.

    A finding that stays as it is keeps the other law among its rivals, with the evidence by which it lost.
    """
    if state.problem.process_noise:
        return state
    for index, found in enumerate(state.found):
        at = state.given + index
        for start in _restatements(state.problem, state.fit, at):
            refitted = try_optimise(state.problem, start, _STEPS, state.fit.whitener)
            trial = None if refitted is None else _as_trial(state, found, start.terms[at].law.name)
            if refitted is None or trial is None:
                continue
            margin = _margin(state, refitted, at)
            if margin > 0 and not state.refutes(refitted):
                state = _adopted(state, refitted, index, replace(trial, evidence=found.trial.evidence + margin))
                return restated(state)
            lost = replace(trial, evidence=found.trial.evidence + min(margin, 0.0))
            state = _with_finding(state, index, replace(found, trials=(*_others(found, lost), lost)))
    return state


def _restatements(problem: Problem, base: Fit, index: int) -> Iterator[Point]:
    """Starts at which a law of a model is another one; none where its element is about as the file says."""
    term = base.point.terms[index]
    law = term.law
    if not isinstance(law, ElementLaw) or law.restated is None or any(term.fixed):
        return
    at = {p.name: index for index, p in enumerate(problem.system.parameters)}
    own = [at.get(f"{term.location}.{quantity}") for quantity in ("stiffness", "damping")]
    away = [abs(base.point.theta[place]) for place in own if place is not None]
    if max(away, default=0.0) <= problem.rules.selection.far:
        return
    element = SpringDamper(*(float(value) for value in base.forward.element_of(term)))
    for other in law.restated(term.parameters, element):
        theta = base.point.theta.copy()
        changes = [one for one in zip(own, other.element, element, strict=True) if one[1] != one[2]]
        for place, new, old in changes:
            if place is not None:
                theta[place] += np.log(new / old)
        if all(place is not None for place, *_ in changes):  # what the file fixes is no other spring
            yield _started(base, index, other, theta)


def _started(base: Fit, index: int, other: Restatement, theta: np.ndarray) -> Point:
    """The model with a law restated as another one, beside other springs and dampers."""
    terms, term = base.point.terms, base.point.terms[index]
    port, grid = term.port(base.forward.system), base.forward.part.grid
    d, v = (motion @ port for motion in base.element_motion)
    motion = seen(base, term, other.element)
    scales = typical_scales(other.law, motion)
    replacement = Term(other.law, term.location, other.parameters, scales=scales)
    warm_start = list(base.point.warm_start)
    place = sum(evaluated_in_time(one) for one in terms[:index])
    if place < len(warm_start):
        warm_start[place] = force_along(other.law, other.parameters, d, v, grid.start + grid.fine_time, other.element)
    terms = (*terms[:index], replacement, *terms[index + 1 :])
    return replace(base.point, theta=theta, terms=terms, warm_start=tuple(warm_start))


def _margin(state: Investigation, refitted: Fit, at: int) -> float:
    """Evidence of a model with a law in other words over the present one, with the priors of springs and dampers."""
    base, rules = state.fit, state.options.rules
    gain = profile_gain(
        base.residual, refitted.residual, len(state.problem.sensors), rules.evidence.quiet, rules.evidence
    )
    gain = min(gain, base.chi_square - refitted.chi_square)
    nearer = float(np.sum(base.point.theta**2) - np.sum(refitted.point.theta**2)) / rules.fit.prior**2
    return gain + nearer + cost(base, rules.evidence, at) - cost(refitted, rules.evidence, at)


def _as_trial(state: Investigation, found: AcceptedFinding, name: str) -> Trial | None:
    """The other law as a trial of the round in which the finding was made; None where its fit diverges."""
    known = [one for one in found.trials if one.term.location == found.trial.term.location]
    known = [one for one in known if one.term.law.name == name]
    if known:
        return known[0]
    first = found.trial
    for start in _restatements(state.problem, first.fit, len(first.fit.point.terms) - 1):
        if start.terms[-1].law.name == name:
            fit = try_optimise(state.problem, start, _STEPS, first.fit.whitener)
            if fit is not None:
                candidate = replace(first.candidate, term=start.terms[-1])
                rise = fit.chi_square - first.fit.chi_square
                return replace(
                    first, candidate=candidate, fit=fit, gain=first.gain - rise, reduction=first.reduction - rise
                )
    return None


def _adopted(state: Investigation, refitted: Fit, index: int, trial: Trial) -> Investigation:
    """The investigation with one of its findings in other words."""
    found = state.found[index]
    runner_up = found.runner_up
    if runner_up is not None and runner_up.term.law.name == trial.term.law.name:
        runner_up = found.trial
    found = replace(found, trial=trial, trials=(*_others(found, trial), found.trial), runner_up=runner_up)
    return _with_finding(with_model(state, refitted), index, found)


def _others(found: AcceptedFinding, trial: Trial) -> tuple[Trial, ...]:
    """The rivals of a finding without those of a trial's law at its place."""
    return tuple(one for one in found.trials if one.term.key[:2] != trial.term.key[:2])


def _with_finding(state: Investigation, index: int, found: AcceptedFinding) -> Investigation:
    return replace(state, found=(*state.found[:index], found, *state.found[index + 1 :]))
