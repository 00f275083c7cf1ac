"""Screening of all laws at all places on the residual of a fit."""

from __future__ import annotations

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.screening.bodies import body_candidates
from sprung.model.diagnosis.screening.elements import element_candidates
from sprung.model.diagnosis.screening.families import ELEMENT, Family
from sprung.model.diagnosis.screening.filters import filter_candidates
from sprung.model.diagnosis.screening.harmonics import harmonic_candidates
from sprung.model.diagnosis.screening.score import Candidate, Projector, Screening
from sprung.model.diagnosis.screening.sensors import measurement_candidates
from sprung.model.diagnosis.screening.structures import structure_candidates
from sprung.model.laws import Law

GROUPS = (
    element_candidates,
    harmonic_candidates,
    body_candidates,
    structure_candidates,
    measurement_candidates,
    filter_candidates,
)


def screen(problem: Problem, fit: Fit, laws: tuple[Law, ...], project: bool = True) -> Screening:
    """Scores of all candidates on the residual of a fit, by p-value."""
    if problem.memory is None:
        return _screened(problem, fit, laws, project)
    rules = problem.rules.screening, problem.rules.plausible, problem.rules.setup  # those that are read
    key = "screen", id(fit), rules, tuple(law.name for law in laws), project
    # the cache holds the fit, so that its id stays unique
    return problem.memory.recall(key, lambda: (fit, _screened(problem, fit, laws, project)))[1]


def _screened(problem: Problem, fit: Fit, laws: tuple[Law, ...], project: bool) -> Screening:
    projector = Projector(problem, fit, project)
    found: list[Candidate] = []
    tests: dict[Family, int] = {}
    for group in GROUPS:
        for candidate, count in group(projector, laws):
            tests[candidate.family] = tests.get(candidate.family, 0) + count
            if candidate.score > 0:
                found.append(candidate)
    found.sort(key=lambda one: (one.p_single, -one.score))
    return Screening(tuple(found), tests or {ELEMENT: 1}, problem.rules.screening.of_laws)
