"""What may be wrong between a rig and its system file: an element elsewhere, or at another body.

What each hypothesis changes in the sensors is weighed beside all parameters, which absorb much of such a fault.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.configuration import changes
from sprung.model.diagnosis.investigation.configuration.effects import (
    ELEMENT_POSITION,
    NEAR,
    WRONG_BODY,
    Hypothesis,
    SetupPlace,
)
from sprung.model.diagnosis.investigation.configuration.scores import SetupScores
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.diagnosis.screening.structures import turns
from sprung.model.schema import GROUND, ForceInput
from sprung.model.system import System


def structure_hypotheses(problem: Problem, fit: Fit, rules: SetupRules) -> Iterator[Hypothesis]:
    """Elements elsewhere along x or y, or with an end at something else, with the misfit that they leave.

    Seen from the fit, which has absorbed some, and from nominal values: the further a fault is, the better from there.
    """
    system = problem.system
    for nominal in (False, True):
        scores = SetupScores(problem, fit, nominal, rules.bins)
        for name in system.elements:
            yield from _elsewhere(scores, system, name, rules)
            yield from _attached(scores, system, name, rules)


def _elsewhere(scores: SetupScores, system: System, name: str, rules: SetupRules) -> Iterator[Hypothesis]:
    for axis in (0, 1):
        if not turns(system, name, "xy"[axis]):
            continue
        found = scores.of_system(changes.moved_element(system, name, axis, NEAR))
        offset = found.amount * NEAR
        if abs(offset) >= rules.offset:
            yield Hypothesis.of(ELEMENT_POSITION, SetupPlace(name, axis=axis), offset, found.misfit)


def _attached(scores: SetupScores, system: System, name: str, rules: SetupRules) -> Iterator[Hypothesis]:
    element, inputs = system.file.elements[name], system.file.inputs
    supports = [one for one, source in inputs.items() if not isinstance(source, ForceInput)]
    for end in ("upper", "lower"):
        now, other = getattr(element, end), getattr(element, {"upper": "lower", "lower": "upper"}[end])
        others = [*system.bodies, GROUND] if now in (*system.bodies, GROUND) else supports
        for to in others:
            if to in (now, other):
                continue
            try:
                found = scores.of_system(changes.attached(system, name, end, to), name)
            except np.linalg.LinAlgError:  # what nothing holds
                continue
            if found.amount > rules.asked:
                site = SetupPlace(name, detail=f"{end} {to}")
                yield Hypothesis(WRONG_BODY, site, None, found.misfit, attaches(name, end, to))


def attaches(name: str, end: str, to: str) -> changes.Undo:
    """An element at what it is fixed to."""
    return changes.in_system(lambda system: changes.attached(system, name, end, to))
