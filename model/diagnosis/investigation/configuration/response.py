"""What a model makes the sensors show of every input, and what a fault of the set-up would have changed in that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from sprung.model.diagnosis.fit.misfit import power
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Group:
    """Channels that may share a fault: sensors and supports by index."""

    sensors: tuple[int, ...] = ()
    supports: tuple[int, ...] = ()
    forces: tuple[int, ...] = ()


NOTHING = Group()


@dataclass(frozen=True)
class ModelResponse:
    """Predictions over the compared bins but the first, without free motion."""

    forward: Forward
    measured: ComplexArray  # (F, S)
    of_support: ComplexArray  # response to each support, (F, S, supports)
    of_force: ComplexArray  # response to each measured force, (F, S, forces)
    motion: ComplexArray  # degrees of freedom, (F, n)
    omega: FloatArray
    step: float  # s, of the samples
    samples: int
    of_raw_force: ComplexArray  # as `of_force`, of the force as it was measured, not as smoothed by a fit

    @classmethod
    def of(cls, problem: Problem, forward: Forward) -> ModelResponse:
        """Of a model on the part of a recording that is fitted."""
        part, plant = forward.part, forward.plant
        band = slice(1, part.grid.band.stop)
        return cls(
            forward=forward,
            measured=part.sensors[band],
            of_support=plant.sensor_of_support[band] * part.support[band][:, None, :],
            of_force=plant.sensor_of_measured_force[band] * part.force[band][:, None, :],
            motion=forward.linear_motion[band],
            omega=part.grid.omega[band],
            step=part.grid.step,
            samples=part.grid.samples,
            of_raw_force=plant.sensor_of_measured_force[band] * problem.part.force[band][:, None, :],
        )

    @cached_property
    def predicted(self) -> ComplexArray:
        """(F, S)."""
        found: ComplexArray = self.of_support.sum(axis=2) + self.of_force.sum(axis=2)
        return found

    def misfit(self, predicted: ComplexArray) -> float:
        """Misfit of all sensors to a prediction."""
        return float(np.sum(power(self.measured - predicted) / self.size))

    @cached_property
    def size(self) -> FloatArray:
        """Power of every sensor, (S,)."""
        return np.maximum(power(self.measured), 1e-300)

    def turned(self, group: Group) -> ComplexArray:
        """Prediction if a group has the other sign."""
        predicted = self.predicted - 2 * self._of(group)
        predicted[:, list(group.sensors)] *= -1
        return predicted

    def late(self, group: Group, late: float) -> ComplexArray:
        """Prediction if a group is delayed: sensors are later, the response to delayed inputs is earlier."""
        turn = np.exp(-1j * self.omega * late)[:, None]
        driven = self._of(group)
        predicted = self.predicted - driven + driven / turn
        at = list(group.sensors)
        predicted[:, at] *= turn
        found: ComplexArray = predicted
        return found

    def scaled(self, group: Group, ratio: float) -> ComplexArray:
        """Prediction if a group is too large by a ratio."""
        driven = self._of(group)
        predicted = self.predicted - driven + driven / ratio
        predicted[:, list(group.sensors)] *= ratio
        return predicted

    def _of(self, group: Group) -> ComplexArray:
        """Response to the inputs of a group, (F, S)."""
        moved = self.of_support[:, :, list(group.supports)].sum(axis=2)
        return np.asarray(moved + self.of_force[:, :, list(group.forces)].sum(axis=2))

    def above(self, frequency: float) -> ModelResponse:
        """The same of the measured force, of the bins from an angular frequency on; the others are empty."""
        keep = (self.omega >= frequency)[:, None]
        return replace(
            self,
            measured=self.measured * keep,
            of_support=self.of_support * keep[:, :, None],
            of_force=self.of_raw_force * keep[:, :, None],
        )

    @property
    def highest_mode(self) -> float:
        """Angular frequency of the fastest mode of the model, rad/s: above it, masses alone determine the response."""
        s = self.forward.plant.structure
        return float(np.sqrt(np.max(np.abs(np.linalg.eigvals((s.H.T * s.stiffness) @ s.H / s.mass[:, None])))))

    def delay(self, group: Group, rules: SetupRules) -> float:
        """The delay of a group with the least misfit, s: the best whole number of samples, then refined."""
        weight = 1 / np.sqrt(self.size)
        driven, predicted, at = self._of(group), self.predicted, list(group.sensors)
        own = np.zeros(len(weight), dtype=bool)
        own[at] = True
        # later sensors: (rest) e^-jwt + driven against Y;   earlier drive: rest + driven e^jwt against Y
        product = np.where(
            own,
            (predicted - driven).conj() * (self.measured - driven),
            driven * (self.measured - predicted + driven).conj(),
        )
        full = np.zeros(self.samples // 2 + 1, dtype=complex)
        full[1 : len(predicted) + 1] = (product * weight**2).sum(axis=1)
        agree = np.fft.irfft(full, self.samples)
        reach = int(min(rules.latest / self.step, rules.late_share * self.samples))
        lags = np.arange(-reach, reach + 1)
        best = float(lags[int(np.argmax(agree[lags]))]) * self.step
        found = minimize_scalar(
            lambda late: self.misfit(self.late(group, late)),
            bounds=(best - self.step, best + self.step),
            method="bounded",
            options={"xatol": 1e-3 * self.step},
        )
        return float(found.x)

    def ratio(self, group: Group) -> float:
        """The ratio by which a group is too large, least squares; sensors or supports."""
        weight = 1 / self.size
        at = list(group.sensors)
        if at:
            predicted, measured, weight = self.predicted[:, at], self.measured[:, at], weight[at]
        else:
            predicted = self._of(group)
            measured = self.measured - self.predicted + predicted
        product = np.sum(np.real(predicted.conj() * measured) * weight)
        found = float(product / max(np.sum(np.abs(predicted) ** 2 * weight), 1e-300))
        return found if at else 1 / found if found else np.inf
