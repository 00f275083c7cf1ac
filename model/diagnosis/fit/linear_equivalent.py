"""The equivalent linear law, which the plant carries so that only the curvature is left to the iteration."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sprung.model.diagnosis.fit.tangent import law_force
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.diagnosis.response.motion import particular_start
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, is_waveform

if TYPE_CHECKING:
    from sprung.model.diagnosis.fit.problem import Problem

_PRELOADS = 4  # rounds of equivalent law and motion


def preloaded(problem: Problem, point: Point) -> Point:
    """The point with the laws' equivalent stiffness and damping moved into the plant.

    The equivalent depends on the motion that the law shapes, so the two are iterated until the loop converges; a
    motion that follows the sensors stays as it is.
    """
    for _ in range(_PRELOADS):
        if not any(is_waveform(t) and "|" not in t.location for t in point.terms):
            return point
        forward = problem.forward(point)
        forces = problem.law_forces(forward, point)
        assert forces is not None
        start = particular_start(forward, forces)
        terms, change, near = [], 0.0, forces.force.copy()
        for term in point.terms:
            if is_waveform(term) and "|" not in term.location:
                k, c = _equivalent(forward, forces, term)
                i = forces.index(term)
                near[:, i] -= (k - term.preload[0]) * forces.deflection[:, i] + (c - term.preload[1]) * forces.rate[
                    :, i
                ]
                element = forward.element_of(term)
                size = abs(float(element.stiffness)) + 1e-12, abs(float(element.damping)) + 1e-12
                change = max(
                    change,
                    abs(k - term.preload[0]) / (size[0] + abs(k)),
                    abs(c - term.preload[1]) / (size[1] + abs(c)),
                )
                terms.append(replace(term, preload=(k, c)))
            else:
                terms.append(term)
        point = replace(point, terms=tuple(terms), near=tuple(near.T))
        if change < 1e-3 or problem.follows:
            break
        # the free state counts from the plant's particular solution, which has changed: keep motion and true state
        moved = problem.forward(point)
        loop = moved.loop(point.state)
        assert loop is not None
        point = replace(point, state=start + point.state - particular_start(moved, loop.answer(near)))
        if forces.converged and change < 0.2:
            break
    return point


def _equivalent(forward: Forward, forces: LawForces, term: Term) -> tuple[float, float]:
    """Stiffness and damping that are nearest to a law along its motion."""
    i = forces.index(term)
    thin = slice(None, None, OVERSAMPLING)
    regressors = np.column_stack([forces.deflection[thin, i], forces.rate[thin, i]])
    sizes = np.maximum(np.std(regressors, axis=0), 1e-300)
    reach = 4.0 * sizes
    f = law_force(forward, term, forces)[thin]
    inside = np.all(np.abs(regressors) < reach, axis=1)
    k, c = np.linalg.lstsq(regressors[inside] / sizes, f[inside], rcond=None)[0] / sizes
    element = forward.element_of(term)
    k = max(k, -0.9 * element.stiffness) if element.stiffness else 0.0  # a body that floats stays afloat
    c = max(c, -0.9 * element.damping) if element.damping else max(c, 0.0)
    if not forces.converged:
        k, c = (k + term.preload[0]) / 2, (c + term.preload[1]) / 2
    return float(k), float(c)
