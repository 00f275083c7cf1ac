"""What may be wrong between a rig and its system file: an element elsewhere, or at another body.

Spring and damper values absorb much of such a fault.  What each hypothesis changes in the sensors is therefore weighed
with the sensitivities of all parameters projected out, in the metric of the misfit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation import setup_changes as changes
from sprung.model.diagnosis.investigation.setup_response import Hypothesis
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.diagnosis.screening.structures import turns
from sprung.model.schema import SystemFileError
from sprung.model.signals import FloatArray
from sprung.model.system import System

_STEP = 1e-3  # of a log-ratio, of differences
NEAR = 0.02  # m, of differences
_LEAST = 0.2  # of a change of bodies that least squares must ask for


@dataclass(frozen=True)
class Weighed:
    """How much of a change least squares asks for beside all parameters."""

    amount: float
    std: float
    left: float  # misfit


class SetupScores:
    """Changes of the set-up weighed on the residual of a fit, or of the nominal values."""

    def __init__(self, problem: Problem, fit: Fit, nominal: bool = False) -> None:
        self.problem, part = problem, problem.part
        self.theta = np.zeros_like(fit.point.theta) if nominal else fit.point.theta
        self.band = slice(1, part.grid.band.stop)
        self.weight = 1 / np.sqrt(np.maximum(np.sum(np.abs(part.sensors[self.band]) ** 2, axis=0), 1e-300))
        self.shown = self._shown(problem.system, self.theta)
        columns = [
            (self._shown(problem.system, self.theta + _STEP * one) - self.shown) / _STEP
            for one in np.eye(len(self.theta))
        ]
        matrix = np.column_stack([self._flat(column) for column in columns])
        self.basis, triangle = np.linalg.qr(matrix)
        self.basis = self.basis[:, np.abs(np.diag(triangle)) > 1e-9 * np.abs(np.diag(triangle)).max()]
        left = part.sensors[self.band] - self.shown if nominal else fit.spectrum[self.band]
        self.residual = self._apart(self._flat(left))

    def of_system(self, system: System, renewed: str = "") -> Weighed:
        """A changed system file; the element `renewed` has its nominal values: at a wrong body it was fitted away."""
        theta = [0.0 if p.element == renewed else x for p, x in zip(system.parameters, self.theta, strict=True)]
        return self.of(self._shown(system, np.array(theta)) - self.shown)

    def of(self, change: ComplexArray) -> Weighed:
        """A change of what the sensors show, (F, S)."""
        column = self._apart(self._flat(change))
        size = float(column @ column)
        if size < 1e-12:
            return Weighed(0.0, np.inf, float(self.residual @ self.residual))
        amount = float(column @ self.residual) / size
        rest = self.residual - amount * column
        left = float(rest @ rest)
        return Weighed(amount, float(np.sqrt(left / len(rest) / size)), left)

    def _shown(self, system: System, theta: FloatArray) -> ComplexArray:
        forward = Forward(system, self.problem.part, self.problem.sensors, theta)
        return forward.linear_sensors[self.band]

    def _flat(self, spectrum: ComplexArray) -> FloatArray:
        flat = (spectrum * self.weight).ravel()
        return np.concatenate([flat.real, flat.imag])

    def _apart(self, column: FloatArray) -> FloatArray:
        return np.asarray(column - self.basis @ (self.basis.T @ column))


def structure_hypotheses(problem: Problem, fit: Fit, rules: SetupRules) -> Iterator[Hypothesis]:
    """Elements elsewhere along x or y, or with an end at something else, with the misfit that they leave.

    Seen from the fit, which has absorbed some, and from nominal values: the further a fault is, the better from there.
    """
    system = problem.system
    for nominal in (False, True):
        scores = SetupScores(problem, fit, nominal)
        for name in system.elements:
            yield from _elsewhere(scores, system, name, rules)
            yield from _attached(scores, system, name)


def _elsewhere(scores: SetupScores, system: System, name: str, rules: SetupRules) -> Iterator[Hypothesis]:
    for axis in (0, 1):
        if not turns(system, name, "xy"[axis]):
            continue
        found = scores.of_system(changes.moved_element(system, name, axis, NEAR))
        offset = found.amount * NEAR
        if abs(offset) >= rules.offset:
            yield Hypothesis("wrong_position", name, offset, found.left, moves_element(name, axis, offset), axis=axis)


def _attached(scores: SetupScores, system: System, name: str) -> Iterator[Hypothesis]:
    element = system.file.elements[name]
    for end in ("upper", "lower"):
        now, other = getattr(element, end), getattr(element, {"upper": "lower", "lower": "upper"}[end])
        others = [*system.bodies, "ground"] if now in (*system.bodies, "ground") else list(system.file.inputs)
        for to in others:
            if to in (now, other):
                continue
            try:
                found = scores.of_system(changes.attached(system, name, end, to), name)
            except (SystemFileError, ValueError, np.linalg.LinAlgError):
                continue
            if found.amount > _LEAST:
                yield Hypothesis("wrong_body", name, None, found.left, attaches(name, end, to), detail=f"{end} {to}")


def moves_element(name: str, axis: int, offset: float) -> changes.Undo:
    """An element where it is."""
    return changes.in_system(lambda system: changes.moved_element(system, name, axis, offset))


def attaches(name: str, end: str, to: str) -> changes.Undo:
    """An element at what it is fixed to."""
    return changes.in_system(lambda system: changes.attached(system, name, end, to))
