"""Windows without any measured input to estimates: wheels on a track, or forces on the structure."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sprung.model.ambient.excitation import Excitation
from sprung.model.ambient.forces import ForceExcitation
from sprung.model.ambient.periodogram import Spectra
from sprung.model.ambient.rules import WINDOW_RULES, AmbientWindowRules
from sprung.model.ambient.sensing import Sensing, sensing
from sprung.model.ambient.speed import Track
from sprung.model.ambient.transient import TransientFit, TransientWindow
from sprung.model.ambient.window import LOAD_STD, AmbientFit, WindowFit
from sprung.model.identifier import PRIOR_STD, StageTimes, checked_windows, without_values
from sprung.model.schema import Body
from sprung.model.signals import BoolArray, Estimate, FloatArray, MeasurementFault
from sprung.model.system import System


class Assumption(Protocol):
    """What is assumed about the sources of a window."""

    def excitation(self, inputs: FloatArray, found: Spectra, sensed: Sensing) -> Excitation | None:
        """For a window's input columns (T, I) and spectra; None if it cannot be used."""


class Forces:
    """Unmeasured forces on every degree of freedom."""

    def __init__(self, system: System) -> None:
        self.inertia = system.mechanics.mass

    def excitation(self, inputs: FloatArray, found: Spectra, sensed: Sensing) -> ForceExcitation:
        return ForceExcitation(self.inertia, found)


class _WindowByWindow(ABC):
    """Identifies windows one after the other."""

    def __init__(self, system: System, rules: AmbientWindowRules) -> None:
        self.system, self.rules, self.times = system, rules, StageTimes()

    @property
    def digest(self) -> str:
        """Names the model that made an estimate."""
        return self.system.digest

    def identify(
        self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False, loads: bool = False
    ) -> list[Estimate]:
        """One `Estimate` per window (B, T, C), NaN columns for absent sensors; see `model.identifier.Identifies`.

        states, loads: ignored, since the excitation is unknown.  Errors: `UnusableWindow`.
        """
        windows = checked_windows(self.system, windows)
        begin = time.perf_counter()
        found = [self._estimate(values, None if start is None else start[b]) for b, values in enumerate(windows)]
        self.times = StageTimes(0.0, time.perf_counter() - begin)
        return found

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        """As `identify`: without measured inputs, wrong sensors cannot be distinguished from forces."""
        return self.identify(windows)

    @abstractmethod
    def _estimate(self, values: FloatArray, start: FloatArray | None) -> Estimate:
        """Of one window (T, C)."""


class AmbientIdentifier(_WindowByWindow):
    """Identifies windows of a system on a track (column 0 is the speed where it is measured) or without inputs."""

    def __init__(self, system: System, rules: AmbientWindowRules = WINDOW_RULES) -> None:
        super().__init__(system, rules)
        varying = {name: body for name, body in system.file.bodies.items() if body.load is not None}
        self.window = WindowFit(system, list(varying), [_load_std(body) for body in varying.values()], rules)
        self.assumption: Assumption = Track(system, self.window) if system.on_track else Forces(system)

    def fit(self, values: FloatArray, start: FloatArray | None = None) -> AmbientFit | None:
        """The fit of one window (T, C); None if it is too quiet, too short or too slow."""
        inputs = len(self.system.inputs)
        sensors = np.flatnonzero(np.isfinite(values[:, inputs:]).all(axis=0))
        if len(sensors) == 0:
            return None
        noise = self.system.sensor_noise[sensors]
        found = self.window.spectra(values[:, inputs + sensors], noise)
        if found is None:
            return None
        sensed = sensing(self.system.mechanics, sensors, noise)
        excitation = self.assumption.excitation(values[:, :inputs], found, sensed)
        if excitation is None:
            return None
        return self.window.judged(self.window.fit(found, sensed, excitation, start), found, sensed)

    def _estimate(self, values: FloatArray, start: FloatArray | None) -> Estimate:
        fit = self.fit(values, start)
        present = np.asarray(np.isfinite(values[:, len(self.system.inputs) :]).all(axis=0))
        P = len(self.system.parameters)
        return without_values(P, len(present)) if fit is None else as_estimate(fit, P, present, self.rules)


class OutputOnlyIdentifier(_WindowByWindow):
    """Identifies windows of a structure without inputs, from free decay to steady ambient vibration.

    Where white forces do not explain a window, forces with a slope over frequency are tried.
    """

    def __init__(self, system: System, rules: AmbientWindowRules = WINDOW_RULES) -> None:
        super().__init__(system, rules)
        self.window, self.coloured = TransientWindow(system, rules), AmbientIdentifier(system, rules)

    def _estimate(self, values: FloatArray, start: FloatArray | None) -> Estimate:
        present = np.asarray(np.isfinite(values).all(axis=0))
        sensors, P = np.flatnonzero(present), len(self.system.parameters)
        fit = self.window.fit(values[:, sensors], sensors, start) if len(sensors) else None
        if fit is None:
            return without_values(P, len(present))
        if not fit.adequate:
            coloured = self.coloured.fit(values, start)
            if coloured is not None:
                seen = as_estimate(coloured, P, present, self.rules)
                if seen.adequate and seen.identifiable.any():
                    return seen
        return _of_transient(fit, P, present, self.rules)


def _of_transient(fit: TransientFit, P: int, present: BoolArray, rules: AmbientWindowRules) -> Estimate:
    """The first P unknowns are the system's parameters."""
    covariance = fit.covariance[:P, :P]
    identifiable = np.sqrt(np.diag(covariance)) < rules.identifiable
    share = fit.noise_share
    per_sensor = np.full(len(present), np.nan)
    per_sensor[present] = share
    return Estimate(
        log_ratio=np.where(identifiable, fit.fitted.x[:P], 0.0),
        covariance=np.where(np.outer(identifiable, identifiable), covariance, np.eye(P) * PRIOR_STD**2),
        identifiable=identifiable,
        nrmse=float(np.sqrt(np.mean(share**2))),
        per_sensor=per_sensor,
        chi_square=fit.chi_square,
        adequate=fit.adequate,
        converged=fit.fitted.converged,
        iterations=fit.fitted.iterations,
        informative=bool(identifiable.any()),
        running=not identifiable.any(),
    )


def as_estimate(fit: AmbientFit, P: int, present: BoolArray, rules: AmbientWindowRules) -> Estimate:
    """The first P unknowns are the system's parameters."""
    fitted = fit.fitted
    # misfit counts as additional noise, which keeps the intervals valid
    covariance = fitted.covariance[:P, :P] * max(1.0, fit.chi_square)
    identifiable = np.sqrt(np.diag(covariance)) < rules.identifiable
    fits = fit.chi_square < 1 + max(rules.sigmas * fit.chi_std, rules.inaccuracy)
    per_sensor = np.full(len(present), np.nan)
    per_sensor[present] = fit.per_sensor
    return Estimate(
        log_ratio=np.where(identifiable, fitted.x[:P], 0.0),
        covariance=np.where(np.outer(identifiable, identifiable), covariance, np.eye(P) * PRIOR_STD**2),
        identifiable=identifiable,
        nrmse=float(np.sqrt(np.mean(fit.per_sensor**2))),
        per_sensor=per_sensor,
        chi_square=fit.chi_square,
        adequate=bool(fits and fitted.converged),
        converged=fitted.converged,
        iterations=fitted.iterations,
        informative=bool(identifiable.any() or not fits),
        running=bool(fits and not identifiable.any()),
    )


def _load_std(body: Body) -> float:
    """Standard deviation of the logarithm of a body's varying mass."""
    if body.load is None or body.load.max is None:
        return LOAD_STD
    mass = body.mass.value
    low, high = mass + (body.load.min or 0.0), mass + body.load.max
    return float(max(np.log(high / mass), np.log(mass / low), 0.02))
