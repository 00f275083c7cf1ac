"""Findings that a later one has made redundant: it explains what they explained at first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.compete import cost
from sprung.model.diagnosis.selection.evidence import process_gain, profile_gain
from sprung.model.diagnosis.selection.starts import structure_starts
from sprung.model.laws import StructureLaw

_STEPS = 8  # of a fit without one finding


def without_redundant(state: Investigation) -> Investigation:
    """The investigation without earlier findings that explain next to nothing beside the last one."""
    rules = state.options.rules
    for index, found in enumerate(state.found[:-1]):
        other = without(state, index)
        if other is None:
            continue
        needed = cost(state.fit, rules.evidence, state.given + index)
        if _gain(other, state) < max(needed, rules.acceptance.idle * found.trial.gain):
            return without_redundant(other)
    return state


def without(state: Investigation, index: int) -> Investigation | None:
    """The investigation without one of its findings, everything else fitted again; None where that diverges."""
    fit, problem = fit_without(state, state.given + index), state.problem
    if fit is None:
        return None
    if problem.process_noise:  # the force noise takes its place
        problem, fit = refreshed(problem, fit)
    kept = (*state.found[:index], *state.found[index + 1 :])
    last = screen(problem, fit, problem.system.catalogue, state.options.project)
    held = replace(state.held, noise=problem.noise)
    return replace(state, problem=problem, fit=fit, held=held, found=kept, last=last)


def _gain(other: Investigation, state: Investigation) -> float:
    """Twice the log-likelihood ratio of an investigation's model over another's."""
    before, after, rules = other.fit, state.fit, state.options.rules.evidence
    sensors = len(state.problem.sensors)
    if state.problem.process_noise:
        return process_gain(before.residual, after.residual, sensors, (before.log_det, after.log_det), rules)
    return profile_gain(before.residual, after.residual, sensors, rules.quiet, rules)


def fit_without(state: Investigation, index: int) -> Fit | None:
    """The model without one of its terms, fitted again with the same weights; None where that diverges."""
    point, forces = state.fit.point, list(state.fit.point.warm_start)
    warm = [forces.pop(0) if evaluated_in_time(term) and forces else None for term in point.terms]
    terms = (*point.terms[:index], *point.terms[index + 1 :])
    start = tuple(force for i, force in enumerate(warm) if i != index and force is not None)
    bare = Point(point.theta, terms, np.zeros(0), start)
    bare = replace(bare, state=np.zeros(state.problem.forward(bare).plant.structure.states))
    tried = (
        try_optimise(state.problem, one, _STEPS, state.fit.whitener) for one in (bare, *_fresh_starts(state, terms))
    )
    return min((fit for fit in tried if fit is not None), key=lambda fit: fit.chi_square, default=None)


def _fresh_starts(state: Investigation, terms: tuple[Term, ...]) -> list[Point]:
    """Starts as if the last finding, a change of the structure, had been the first.

    Beside another finding its values may be far from those it has alone: two springs between the same bodies are
    equivalent to one of them moved and a third.
    """
    if len(terms) != state.given + 1 or not isinstance(terms[-1].law, StructureLaw):
        return []
    candidates = [candidate for candidate in state.first.candidates if candidate.term.key == terms[-1].key]
    return [start for candidate in candidates for start in structure_starts(state.problem, state.base, candidate)]
