"""Starts along the measured motion, for candidates whose simulation is far from it.

A model without a gross law moves elsewhere than the recording, so that neither scores along its motion nor steps from
its parameters lead to that law.  With an unmeasured force on every body, as strong as it has to be, the smoothed motion
is the measured one; what is fitted along it (one-step prediction instead of simulation) begins near the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed, with_force_noise
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import evaluated_in_time
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.starts import joint_start, seen, wider_starts
from sprung.model.laws import ElementLaw
from sprung.model.schema import ForceInput
from sprung.model.system import System

_STEPS, _ROUNDS = 8, 5  # of a fit along the measured motion, and how often it goes on
_BLUNT = 0.25  # of the rms rate, width of a corner from which a fit sharpens it
_PER_MASS = 1.0  # m/s^2, first level of the unmeasured forces over the masses they act on


@dataclass(frozen=True)
class MeasuredMotion:
    """The present model along the measured motion."""

    problem: Problem  # with an unmeasured force on every body
    fit: Fit

    @classmethod
    def of(cls, problem: Problem, base: Fit) -> MeasuredMotion | None:
        """Of the terms of a fit; None if it diverges, or if forces are estimated anyway."""
        if problem.process_noise:
            return None
        system, part, count = problem.system, problem.part, len(problem.system.bodies)
        still = replace(
            part,
            force=np.zeros((len(part.force), count), dtype=part.force.dtype),
            force_polynomial=np.zeros((len(part.force_polynomial), count)),
        )
        masses = [system.file.bodies[body].mass.value for body in system.bodies]
        noise = replace(problem.noise, force=_PER_MASS * np.array(masses))
        along = replace(problem, system=with_disturbances(system), part=still, noise=noise, memory=None)
        start = Point(np.zeros_like(base.point.theta), base.point.terms, np.zeros(0))
        start = replace(start, state=np.zeros(along.forward(start).plant.structure.states))
        try:
            with np.errstate(all="ignore"):
                along = with_force_noise(along, start)
        except (np.linalg.LinAlgError, FloatingPointError):
            return None
        fit = try_optimise(along, start, _STEPS)
        return None if fit is None else cls(along, fit)

    def wider(self, index: int) -> Point | None:
        """The present model with one of its laws in the wider form, fitted along the measured motion; None: no form."""
        tried = (try_optimise(self.problem, start, _STEPS) for start in wider_starts(self.fit, index))
        best = min((one for one in tried if one is not None), key=lambda one: one.deviance, default=None)
        if best is None or best.deviance > self.fit.deviance - self.problem.rules.report.naming_margin:
            return None
        settled = try_optimise(self.problem, best.point, _STEPS)
        return best.point if settled is None else settled.point

    def starts(self, candidate: Candidate) -> list[Point]:
        """A candidate beside the present model, with all values as fitted along the measured motion.

        If its law has a wider form that explains more there, in this form, too.
        """
        if not evaluated_in_time(candidate.term):
            return []
        begun = joint_start(self.problem, self.fit, candidate)
        fit = self._fitted(begun)
        if fit is None:
            return []
        beside = MeasuredMotion(*refreshed(self.problem, fit))  # what is left unmeasured beside it
        wide = beside.wider(len(fit.point.terms) - 1)
        points = [beside.fit.point] if wide is None else [beside.fit.point, wide]
        return [_blunt(beside.fit, point) for point in points]

    def _fitted(self, start: Point) -> Fit | None:
        """A fit along the measured motion, to convergence; None if it diverges."""
        fit = try_optimise(self.problem, start, _STEPS)
        for _ in range(_ROUNDS):
            if fit is None or fit.converged:
                break
            fit = try_optimise(self.problem, fit.point, _STEPS) or fit
        return fit


def _blunt(fit: Fit, point: Point) -> Point:
    """A point with a wide corner of its last law, if it has one: a fit sharpens it (graduated optimisation).

    Simulations along sharp corners are rough functions of all values, whose steps mislead.
    """
    term = point.terms[-1]
    if not isinstance(term.law, ElementLaw) or term.law.corner is None:
        return point
    values = np.array(term.parameters)
    values[term.law.corner] = max(values[term.law.corner], _BLUNT * seen(fit, term).rate_rms)
    return replace(point, terms=(*point.terms[:-1], term.at(values)))


def with_disturbances(system: System) -> System:
    """A system with one more force input on every body, for what nobody measured."""
    forces = {f"disturbance of {body}": ForceInput(kind="force", body=body) for body in system.bodies}
    return replace(system, file=system.file.model_copy(update={"inputs": {**system.file.inputs, **forces}}))
