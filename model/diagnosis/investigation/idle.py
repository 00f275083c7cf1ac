"""Findings that a later one has made idle: what they explained at first, it explains too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, is_waveform
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.evidence import profile_gain
from sprung.model.diagnosis.selection.starts import structure_starts
from sprung.model.laws import StructureLaw

_STEPS = 8  # of a fit without one finding


def without_idle(state: Investigation) -> Investigation:
    """An investigation without earlier findings that explain next to nothing beside the last one."""
    rules = state.options.rules
    if state.problem.process_noise:
        return state
    for index, found in enumerate(state.found[:-1]):
        fit = _without(state, state.given + index)
        if fit is None:
            continue
        sensors = len(state.problem.sensors)
        gain = profile_gain(fit.residual, state.fit.residual, sensors, rules.evidence.quiet, rules.evidence)
        if gain < rules.acceptance.idle * found.trial.gain:
            kept = (*state.found[:index], *state.found[index + 1 :])
            last = screen(state.problem, fit, state.problem.system.catalogue, state.options.project)
            return without_idle(replace(state, fit=fit, found=kept, last=last))
    return state


def _without(state: Investigation, index: int) -> Fit | None:
    """The model without one of its terms, fitted again with the same weights; None where that diverges."""
    point, forces = state.fit.point, list(state.fit.point.warm_start)
    near = [forces.pop(0) if is_waveform(term) and forces else None for term in point.terms]
    terms = (*point.terms[:index], *point.terms[index + 1 :])
    start = tuple(force for i, force in enumerate(near) if i != index and force is not None)
    bare = Point(point.theta, terms, np.zeros(0), start)
    bare = replace(bare, state=np.zeros(state.problem.forward(bare).plant.structure.states))
    tried = (try_optimise(state.problem, one, _STEPS, state.fit.whitener) for one in (bare, *_afresh(state, terms)))
    return min((fit for fit in tried if fit is not None), key=lambda fit: fit.chi_square, default=None)


def _afresh(state: Investigation, terms: tuple[Term, ...]) -> list[Point]:
    """Starts as if the last finding, a part of the structure, had been the first.

    Beside another one its values may be far from its own: two springs between the same bodies are as well one of them
    moved and a third.
    """
    if len(terms) != state.given + 1 or not isinstance(terms[-1].law, StructureLaw):
        return []
    candidates = [candidate for candidate in state.first.candidates if candidate.term.key == terms[-1].key]
    return [start for candidate in candidates for start in structure_starts(state.problem, state.base, candidate)]
