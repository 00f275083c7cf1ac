"""Equivalent linearisation of laws: it becomes part of the plant, so that only the curvature is iterated.

Stiffness and damping that approximate the law's force along its motion in least squares (statistical
linearisation, Roberts and Spanos 2003; for one harmonic the describing function).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.problem import Problem, SmoothedInputs, law_forces
from sprung.model.diagnosis.fit.tangent import law_force
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.diagnosis.response.motion import particular_start
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.signals import FloatArray

_ROUNDS = 4  # alternations of equivalent and motion
_SETTLED = 1e-3  # largest change of an equivalent stiffness or damping, as a share of it and the element's
_ROUGH = 1e-3  # relative tolerance of the forces from which an equivalent is computed
_NEAR = 0.2  # the same, if the harmonic balance converges anyway


def with_equivalents(problem: Problem, point: Point, inputs: SmoothedInputs | None) -> Point:
    """The point with the laws' equivalent stiffness and damping moved into the plant.

    The equivalent depends on the motion, which depends on the law: both are iterated until the harmonic balance
    converges.  A smoothed motion is kept.
    """
    if not any(_carried(term) for term in point.terms):
        return point
    forward = problem.forward(point, inputs)
    for _ in range(_ROUNDS):
        forces = law_forces(forward, point, inputs, _ROUGH)
        if forces is None:
            return point
        start = particular_start(forward, forces)
        terms, force, change = _moved(forward, forces, point)
        point = replace(point, terms=terms, warm_start=tuple(force.T))
        if change < _SETTLED or problem.process_noise:
            break
        # the particular solution of the plant has changed: the free state is shifted so that the total state stays
        forward = problem.forward(point, inputs)
        balance = forward.harmonic_balance(point.state)
        if balance is not None:
            point = replace(point, state=start + point.state - particular_start(forward, balance.solution(force)))
        if forces.converged and change < _NEAR:
            break
    return point


def _carried(term: Term) -> bool:
    """Whether a law's equivalent can be part of the plant; that of a pair would couple two elements."""
    return evaluated_in_time(term) and "|" not in term.location


def _moved(forward: Forward, forces: LawForces, point: Point) -> tuple[tuple[Term, ...], FloatArray, float]:
    """Terms with their present equivalents, the laws' forces without them (4N, m), and the largest relative change."""
    terms, change, force = [], 0.0, forces.force.copy()
    for term in point.terms:
        if _carried(term):
            k, c = _equivalent(forward, forces, term)
            more_k, more_c = k - term.equivalent[0], c - term.equivalent[1]
            i = forces.index(term)
            force[:, i] -= more_k * forces.deflection[:, i] + more_c * forces.rate[:, i]
            element = forward.element_of(term)
            size = abs(float(element.stiffness)) + 1e-12, abs(float(element.damping)) + 1e-12
            change = max(change, abs(more_k) / (size[0] + abs(k)), abs(more_c) / (size[1] + abs(c)))
            terms.append(replace(term, equivalent=(k, c)))
        else:
            terms.append(term)
    return tuple(terms), force, change


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
    k = max(k, -0.9 * element.stiffness) if element.stiffness else 0.0  # unconstrained bodies stay unconstrained
    c = max(c, -0.9 * element.damping) if element.damping else max(c, 0.0)
    if not forces.converged:
        k, c = (k + term.equivalent[0]) / 2, (c + term.equivalent[1]) / 2
    return float(k), float(c)
