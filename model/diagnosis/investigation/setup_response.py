"""What a model makes the sensors show of every input, and what a fault of the set-up would have changed in that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

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


def relative(error: ComplexArray, measured: ComplexArray) -> FloatArray:
    """Misfit of every sensor, (S,), of errors (F, S)."""
    return np.asarray(_power(error) / np.maximum(_power(measured), 1e-300))


def _power(spectrum: ComplexArray) -> FloatArray:
    """Sum of squares of every column, (S,)."""
    parts = spectrum.real, spectrum.imag
    return np.asarray(sum(np.einsum("fs,fs->s", part, part) for part in parts))


@dataclass(frozen=True)
class ModelResponse:
    """Compared bins but the first, without free motion."""

    forward: Forward
    measured: ComplexArray  # (F, S)
    of_support: ComplexArray  # shown of each support, (F, S, supports)
    of_force: ComplexArray  # shown of each measured force, (F, S, forces)
    motion: ComplexArray  # degrees of freedom, (F, n)
    omega: FloatArray
    step: float  # s, of the samples
    samples: int
    of_raw_force: ComplexArray  # as `of_force`, of the force as it was measured: a fit may bend it to its needs

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
    def shown(self) -> ComplexArray:
        """(F, S)."""
        found: ComplexArray = self.of_support.sum(axis=2) + self.of_force.sum(axis=2)
        return found

    def left(self, shown: ComplexArray) -> float:
        """Misfit of all sensors if this is what they show."""
        return float(np.sum(_power(self.measured - shown) / self.size))

    @cached_property
    def size(self) -> FloatArray:
        """Power of every sensor, (S,)."""
        return np.maximum(_power(self.measured), 1e-300)

    def turned(self, group: Group) -> ComplexArray:
        """Shown if a group has the other sign."""
        shown = self.shown - 2 * self._of(group)
        shown[:, list(group.sensors)] *= -1
        return shown

    def late(self, group: Group, late: float) -> ComplexArray:
        """Shown if a group is late: sensors show later, what late inputs drive comes earlier."""
        turn = np.exp(-1j * self.omega * late)[:, None]
        driven = self._of(group)
        shown = self.shown - driven + driven / turn
        at = list(group.sensors)
        shown[:, at] *= turn
        found: ComplexArray = shown
        return found

    def scaled(self, group: Group, ratio: float) -> ComplexArray:
        """Shown if a group is too large by a ratio."""
        driven = self._of(group)
        shown = self.shown - driven + driven / ratio
        shown[:, list(group.sensors)] *= ratio
        return shown

    def _of(self, group: Group) -> ComplexArray:
        """Shown of the inputs of a group, (F, S)."""
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
        """Angular frequency of the fastest mode of the model, rad/s: above it masses alone tell what a force does."""
        s = self.forward.plant.structure
        return float(np.sqrt(np.max(np.abs(np.linalg.eigvals((s.H.T * s.stiffness) @ s.H / s.mass[:, None])))))

    def delay(self, group: Group, rules: SetupRules) -> float:
        """The delay of a group that leaves the least misfit, s: the best of all whole samples, then between them."""
        weight = 1 / np.sqrt(self.size)
        driven, shown, at = self._of(group), self.shown, list(group.sensors)
        own = np.zeros(len(weight), dtype=bool)
        own[at] = True
        # later sensors: (rest) e^-jwt + driven against Y;   earlier drive: rest + driven e^jwt against Y
        product = np.where(
            own,
            (shown - driven).conj() * (self.measured - driven),
            driven * (self.measured - shown + driven).conj(),
        )
        full = np.zeros(self.samples // 2 + 1, dtype=complex)
        full[1 : len(shown) + 1] = (product * weight**2).sum(axis=1)
        agree = np.fft.irfft(full, self.samples)
        reach = int(min(rules.latest / self.step, rules.late_share * self.samples))
        lags = np.arange(-reach, reach + 1)
        best = float(lags[int(np.argmax(agree[lags]))]) * self.step
        found = minimize_scalar(
            lambda late: self.left(self.late(group, late)),
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
            shown, measured, weight = self.shown[:, at], self.measured[:, at], weight[at]
        else:
            shown = self._of(group)
            measured = self.measured - self.shown + shown
        product = np.sum(np.real(shown.conj() * measured) * weight)
        found = float(product / max(np.sum(np.abs(shown) ** 2 * weight), 1e-300))
        return found if at else 1 / found if found else np.inf
