"""All laws at all places, screened on the residual of a fit."""

from __future__ import annotations

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.screening.bodies import body_hits
from sprung.model.diagnosis.screening.elements import element_hits
from sprung.model.diagnosis.screening.harmonics import harmonic_hits
from sprung.model.diagnosis.screening.score import Hit, Projector, Screening
from sprung.model.diagnosis.screening.sensors import measurement_hits
from sprung.model.laws import Law

GROUPS = (element_hits, harmonic_hits, body_hits, measurement_hits)


def screen(problem: Problem, fit: Fit, laws: tuple[Law, ...], project: bool = True) -> Screening:
    """Score every candidate on the residual of a fit, by the smallest chance of such a score first."""
    projector = Projector(problem, fit, project)
    hits: list[Hit] = []
    tests: dict[str, int] = {}
    for group in GROUPS:
        for hit, count in group(projector, laws):
            tests[hit.family] = tests.get(hit.family, 0) + count
            if hit.score > 0:
                hits.append(hit)
    hits.sort(key=lambda h: (h.p_single, -h.score))
    return Screening(tuple(hits), tests or {"law": 1})
