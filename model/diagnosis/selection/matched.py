"""Starts of a second law beside a first one whose wider form shows the force that both have together.

Beside a wrong law, the values of the first and its element's damper have absorbed most of what a second law would
explain, and steps from there lead into valleys of the wrong law.  The wider form of the first law shows the force of
the element over its motion much better.  Both laws, spring and damper are fitted to that force, which needs no
simulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

_SAMPLES = 4000  # of a motion, that forces are compared on
_EVALUATIONS = 60  # of a fit of forces
_FAR = 1e6  # a force out of range, over the force shown
_ALIKE = 0.05  # log-ratio of dampings, below which fits are one


@dataclass(frozen=True)
class _ShownForce:
    """An element's force along a motion, and two laws that may make it."""

    deflection: FloatArray  # (T,)
    rate: FloatArray
    time: FloatArray
    force: FloatArray  # N
    element: SpringDamper  # of the first law alone
    free: tuple[bool, bool]  # whether spring and damper are estimated
    terms: tuple[Term, Term]

    def left(self, x: FloatArray) -> FloatArray:
        """The force that is left (T,), over the one shown, at internal values."""
        element, terms = self.at(x)
        force = element.stiffness * self.deflection + element.damping * self.rate
        for term in terms:
            law, values = term.element_law, term.parameters
            force = force + force_along(law, values, self.deflection, self.rate, self.time, element)
        left = (force - self.force) / np.std(self.force)
        return np.asarray(np.nan_to_num(left, nan=_FAR, posinf=_FAR, neginf=-_FAR))

    def at(self, x: FloatArray) -> tuple[SpringDamper, tuple[Term, ...]]:
        """Spring and damper, and the laws, at internal values: log-ratios of the former, then the laws' own."""
        logs = np.zeros(2)
        logs[list(self.free)] = x[: sum(self.free)]
        element = SpringDamper(*(np.array(self.element) * np.exp(logs)))
        terms, values = [], x[sum(self.free) :]
        for term in self.terms:
            own, values = np.split(values, [len(term.parameters)])
            specs = term.law.parameters
            found = [np.exp(u) if q.log else u * s for q, u, s in zip(specs, own, term.scales, strict=True)]
            terms.append(term.at(term.element_law.clip(found)))
        return element, tuple(terms)

    def internal(self, damping: float) -> FloatArray:
        """Internal values of the laws as they are, at a factor of the damper."""
        values = [value for value, free in zip((0.0, np.log(damping)), self.free, strict=True) if free]
        for term in self.terms:
            for spec, value, scale in zip(term.law.parameters, term.parameters, term.scales, strict=True):
                values.append(float(np.log(value)) if spec.log else value / scale)
        return np.array(values)


def matched_starts(problem: Problem, base: Fit, shown: Fit, index: int, candidate: Candidate) -> Iterator[Point]:
    """A second law beside one of a model's laws, both fitted to the force that a model with its wider form shows.

    index: of the first law's term, in both models.  Several where several pairs make that force: a friction and a valve
    may change their parts.  None for laws that are no force in time.
    """
    first = base.point.terms[index]
    if not evaluated_in_time(candidate.term):
        return
    names = [p.name for p in problem.system.parameters]
    places = [names.index(one) if one in names else None for one in _own(first.location)]
    force = _shown(base, shown, index, candidate.term, (places[0] is not None, places[1] is not None))
    known: list[float] = []  # dampings
    for x in sorted(_fits(problem, force, candidate), key=lambda x: float(np.sum(force.left(x) ** 2))):
        element, (one, other) = force.at(x)
        if any(abs(np.log(element.damping / damping)) < _ALIKE for damping in known):
            continue
        known.append(element.damping)
        theta = base.point.theta.copy()
        for place, new, old in zip(places, element, force.element, strict=True):
            if place is not None:
                theta[place] += np.log(new / old)
        start = start_of(base, replace(candidate, term=other))
        yield replace(start, theta=theta, terms=(*start.terms[:index], one, *start.terms[index + 1 :]))


def _own(location: str) -> tuple[str, str]:
    return f"{location}.stiffness", f"{location}.damping"


def _shown(base: Fit, shown: Fit, index: int, second: Term, free: tuple[bool, bool]) -> _ShownForce:
    """The force of the element of a term in a model that shows it well."""
    wide, grid = shown.point.terms[index], shown.forward.part.grid
    port = wide.port(shown.forward.system)
    d, v = (motion @ port for motion in shown.element_motion)
    k, c = (float(value) for value in shown.forward.element_of(wide))
    force = k * d + c * v + shown.force_along(wide)
    thin = slice(None, None, max(1, len(d) // _SAMPLES))
    element = SpringDamper(*(float(value) for value in base.forward.element_of(wide)))
    time = (grid.start + grid.fine_time)[thin]
    return _ShownForce(d[thin], v[thin], time, force[thin], element, free, (base.point.terms[index], second))


def _fits(problem: Problem, force: _ShownForce, candidate: Candidate) -> list[FloatArray]:
    """Internal values of the two laws fitted to a force, from the damper as it is read and from the nominal one."""
    name = _own(candidate.location)[1]
    nominal = [p.nominal / force.element.damping for p in problem.system.parameters if p.name == name]
    with np.errstate(all="ignore"):
        begun = [force.internal(damping) for damping in (1.0, *nominal)]
        fits = [least_squares(force.left, x, max_nfev=_EVALUATIONS) for x in begun if np.all(np.isfinite(x))]
    return [fit.x for fit in fits if np.all(np.isfinite(fit.x))]
