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
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time, given_terms
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.starts import joint_start, seen, wider_starts
from sprung.model.schema import ForceInput
from sprung.model.signals import FloatArray
from sprung.model.system import System

_STEPS, _ROUNDS = 8, 5  # of a fit along the measured motion, and how often it goes on
SHARPENED = 20  # steps of a simulation, in which a blunt corner becomes sharp
_BLUNT, _LESS_BLUNT = 0.25, 0.1  # of the rms rate, widths of corners from which a simulation's fit sharpens them
_SHARP = 0.01  # the same along the measured motion, which corners do not change
_DISTURBANCE = "disturbance of "  # and a body: name of an unmeasured force
_PER_MASS = 1.0  # m/s^2, first level of the unmeasured forces over the masses they act on


@dataclass(frozen=True)
class ForceAlongMotion:
    """What an element has to carry along a motion, evenly sampled."""

    time: FloatArray  # s since the start of the recording, (T,)
    deflection: FloatArray  # m, (T,)
    rate: FloatArray  # m/s, (T,)
    force: FloatArray  # N, of spring, damper, and whatever the system file lacks, (T,)


def force_along_motion(fit: Fit, element: str) -> ForceAlongMotion:
    """The force of an element along a fit's own motion: of spring, damper and the laws that are not the file's."""
    system, grid, thin = fit.forward.system, fit.forward.part.grid, slice(None, None, OVERSAMPLING)
    d, v = (motion[:, system.elements.index(element)] for motion in fit.element_motion)
    own, given = fit.forward.element_at(element), len(given_terms(system))
    laws = [fit.force_along(term) for term in fit.point.terms[given:] if term.location == element]
    force = float(own.stiffness) * d + float(own.damping) * v + np.sum(laws, axis=0)
    return ForceAlongMotion((grid.start + grid.fine_time)[thin], d[thin], v[thin], force[thin])


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

    def force_of(self, element: str) -> ForceAlongMotion:
        """The force of an element: its own, and the unmeasured one of the body that determines it best.

        That is the body with the fewest other elements, whose errors it contains too; of two such, the mean.
        """
        system, part, grid = self.problem.system, self.fit.forward.part, self.fit.forward.part.grid
        bodies, elements = list(system.bodies), system.file.elements
        both = {elements[element].upper: -1.0, elements[element].lower: 1.0}
        ends = {end: sign for end, sign in both.items() if end in bodies}
        others = {body: sum(body in (one.upper, one.lower) for one in elements.values()) for body in ends}
        fewest = [body for body in ends if others[body] == min(others.values())]
        unmeasured = grid.fine(part.force) + grid.fine_monomials @ part.force_polynomial
        columns = {body: len(part.force[0]) - len(bodies) + bodies.index(body) for body in fewest}
        missing = np.mean([ends[body] * unmeasured[:, columns[body]] for body in fewest], axis=0)
        own = force_along_motion(self.fit, element)
        return replace(own, force=own.force + missing[::OVERSAMPLING])

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
        fit = self.fitted(begun)
        if fit is None:
            return []
        beside = MeasuredMotion(*refreshed(self.problem, fit))  # what is left unmeasured beside it
        wide = beside.wider(len(fit.point.terms) - 1)
        points = [beside.fit.point] if wide is None else [beside.fit.point, wide]
        return [_blunt(beside.fit, point) for point in points]

    def fitted(self, start: Point) -> Fit | None:
        """A fit along the measured motion, to convergence; None if it diverges."""
        fit = try_optimise(self.problem, start, _STEPS)
        for _ in range(_ROUNDS):
            if fit is None or fit.converged:
                break
            fit = try_optimise(self.problem, fit.point, _STEPS) or fit
        return fit


def sharpened(problem: Problem, fit: Fit) -> Fit:
    """A fit whose last law has a corner, begun once more from where the whole model fits the measured motion.

    Simulations along sharp corners have many local optima; the fit of the lowest chi-square is returned.
    """
    term = fit.point.terms[-1]
    if term.law.corner is None:
        return fit
    measured = MeasuredMotion.of(problem, fit)
    along = None if measured is None else measured.fitted(_with_corner(measured.fit, term, _SHARP))
    if measured is None or along is None:
        return fit
    for _ in range(2):  # what is left unmeasured falls by orders beside a law that is right
        measured = MeasuredMotion(*refreshed(replace(measured.problem, noise=along.noise), along))
        along = measured.fit
    starts = [_with_corner(along, along.point.terms[-1], width) for width in (_BLUNT, _LESS_BLUNT)]
    tried = [try_optimise(problem, start, SHARPENED, fit.whitener) for start in starts]
    best = min((one for one in (fit, *tried) if one is not None), key=lambda one: one.chi_square)
    on = None if best is fit or best.converged else try_optimise(problem, best.point, SHARPENED, fit.whitener)
    return best if on is None or on.chi_square >= best.chi_square else on


def _blunt(fit: Fit, point: Point) -> Point:
    """A point with a wide corner of its last law, if it has one: a fit sharpens it (graduated optimisation).

    Simulations along sharp corners are rough functions of all values, whose steps mislead.
    """
    term = point.terms[-1]
    if term.law.corner is None:
        return point
    wide, corner = _with_corner(fit, term, _BLUNT).terms[-1], term.law.corner
    return point if wide.parameters[corner] < term.parameters[corner] else _ending(point, wide)


def _with_corner(fit: Fit, term: Term, share: float) -> Point:
    """The point of a fit with its last term exchanged for one whose corner is a share of the rms rate wide."""
    values, corner = np.array(term.parameters), term.law.corner
    assert corner is not None, f"{term.law.name} has no corner"
    values[corner] = share * seen(fit, term).rate_rms
    return _ending(fit.point, term.at(values))


def _ending(point: Point, term: Term) -> Point:
    return replace(point, terms=(*point.terms[:-1], term))


def with_disturbances(system: System) -> System:
    """A system with a force input, for unmeasured forces, on every body whose force is not measured."""
    exact = {"kind": "force", "gain_std": 0.0, "offset_std": 0.0}  # there is no instrument that may err
    forces = {_DISTURBANCE + body: ForceInput.model_validate(exact | {"body": body}) for body in unpushed(system)}
    return replace(system, file=system.file.model_copy(update={"inputs": {**system.file.inputs, **forces}}))


def unpushed(system: System) -> list[str]:
    """Bodies of a system without a force input."""
    pushed = {source.body for source in system.file.inputs.values() if isinstance(source, ForceInput)}
    return [body for body in system.bodies if body not in pushed]


def disturbed(system: System) -> set[str]:
    """Bodies of a system under an unmeasured force."""
    return {name.removeprefix(_DISTURBANCE) for name in system.file.inputs if name.startswith(_DISTURBANCE)}
