"""Least-squares estimates of changes of a set-up in the misfit's metric, sensitivities of parameters projected out.

Spring and damper values absorb much of a configuration fault; only the rest is informative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray, ThinnedGrid
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.signals import FloatArray
from sprung.model.system import System

_STEP = 1e-3  # of a log-ratio, of differences


@dataclass(frozen=True)
class ChangeEstimate:
    """Least-squares amount of a change beside all parameters."""

    amount: float
    std: float
    misfit: float  # that remains


class SetupScores:
    """Estimates of changes of the set-up on the residual of a fit, or of the nominal values."""

    def __init__(self, problem: Problem, fit: Fit, nominal: bool = False, most: int | None = None) -> None:
        """most: number of bins that are used, evenly spread over the compared ones; None: all of them."""
        self.problem, part = problem, problem.part
        self.theta = np.zeros_like(fit.point.theta) if nominal else fit.point.theta
        stride = 1 if most is None else max(1, part.grid.band.stop // most)
        self.grid = ThinnedGrid(part.grid.samples, part.grid.step, part.grid.start, part.grid.compared, stride=stride)
        self.band = slice(stride, part.grid.band.stop, stride)  # the same, without zero frequency
        self.weight = 1 / np.sqrt(np.maximum(np.sum(np.abs(part.sensors[self.band]) ** 2, axis=0), 1e-300))
        self.predicted = self._predict(problem.system, self.theta)
        columns = [
            (self._predict(problem.system, self.theta + _STEP * one) - self.predicted) / _STEP
            for one in np.eye(len(self.theta))
        ]
        matrix = np.column_stack([self._flat(column) for column in columns])
        self.basis, triangle = np.linalg.qr(matrix)
        self.basis = self.basis[:, np.abs(np.diag(triangle)) > 1e-9 * np.abs(np.diag(triangle)).max()]
        residual = part.sensors[self.band] - self.predicted if nominal else fit.spectrum[self.band]
        self.residual = self._projected(self._flat(residual))

    def of_system(self, system: System, renewed: str = "") -> ChangeEstimate:
        """A changed system file; the element `renewed` has its nominal values: a wrong body voids its fit."""
        theta = [0.0 if p.element == renewed else x for p, x in zip(system.parameters, self.theta, strict=True)]
        return self.of(self._predict(system, np.array(theta)) - self.predicted)

    def of(self, change: ComplexArray) -> ChangeEstimate:
        """A change of the predicted sensors, (F, S)."""
        column = self._projected(self._flat(change))
        size = float(column @ column)
        if size < 1e-12:
            return ChangeEstimate(0.0, np.inf, float(self.residual @ self.residual))
        amount = float(column @ self.residual) / size
        rest = self.residual - amount * column
        misfit = float(rest @ rest)
        return ChangeEstimate(amount, float(np.sqrt(misfit / len(rest) / size)), misfit)

    def _predict(self, system: System, theta: FloatArray) -> ComplexArray:
        forward = Forward(system, self.problem.part, self.problem.sensors, theta)
        plant, part = replace(forward.plant, grid=self.grid), self.problem.part
        return plant.sensors_once(part.support[self.band], part.force[self.band])

    def _flat(self, spectrum: ComplexArray) -> FloatArray:
        flat = (spectrum * self.weight).ravel()
        return np.concatenate([flat.real, flat.imag])

    def _projected(self, column: FloatArray) -> FloatArray:
        return np.asarray(column - self.basis @ (self.basis.T @ column))
