"""Windows in, estimates out: the trained estimator gives the start, the simulator refines it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sprung.model.ambient.foreseen import foreseen
from sprung.model.ambient.identify import AmbientIdentifier
from sprung.model.identification.estimator import Estimator, bundled_estimator, load_estimator
from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.linearise import PRIOR_STD
from sprung.model.identification.refine import Refined, Refiner
from sprung.model.identification.with_laws import IdentifierWithLaws, acting_laws, without_laws
from sprung.model.identifier import Identifies, StageTimes, UnusableWindow
from sprung.model.signals import Estimate, FloatArray
from sprung.model.system import System

_FIT_SIGMAS = 6.0  # chi-square further than this above its expectation: the window does not fit
EXCITED = 20.0  # power of an input over its noise; below, what sensors show is not the response to the inputs


@dataclass(slots=True)
class Identifier:
    """Identifies windows of one system.  Stateless but for `times` and cached workspaces; use one per thread.

    workers: threads that share a batch of windows (see `Refiner`).
    """

    system: System
    estimator: Estimator | None = None
    workers: int = 1
    times: StageTimes = field(default_factory=StageTimes)
    _refiners: dict[int, Refiner] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Names the model that made an estimate: system, and weights where an estimator is used."""
        return self.system.digest + (f"-{self.estimator.digest}" if self.estimator is not None else "")

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """One `Estimate` per window.

        windows: (B, T, C) in the order of `system.channels`, NaN columns for absent sensors.
        start: log-ratios (B, P) to refine from, such as the tracker's; the estimator's where left out.
        Errors: `UnusableWindow` for a wrong shape or an input that is not finite.
        """
        windows = self._checked(windows)
        if len(windows) == 0:
            return []
        begin = time.perf_counter()
        if start is None and self.estimator is not None and windows.shape[1] == self.estimator.samples:
            start = self.estimator.estimate(windows, self.workers).log_ratio
        between = time.perf_counter()
        refined = self._refiner(windows.shape[1]).refine(windows, start, states=states)
        self.times = StageTimes(between - begin, time.perf_counter() - between)
        return _estimates(refined, states)

    def _refiner(self, samples: int) -> Refiner:
        if samples not in self._refiners:
            self._refiners[samples] = Refiner(self.system, samples, self.workers)
        return self._refiners[samples]

    def _checked(self, windows: FloatArray) -> FloatArray:
        windows = np.asarray(windows, dtype=np.float64)
        channels = self.system.channels
        if windows.ndim != 3 or windows.shape[2] != len(channels):
            raise UnusableWindow(f"windows: shape (B, T, {len(channels)}) expected, {windows.shape} came")
        bad = ~np.isfinite(windows)
        inputs = len(self.system.inputs)
        for column in np.flatnonzero(bad.any(axis=(0, 1))):
            if column < inputs:
                raise UnusableWindow(f"{channels[column].name}: input is missing or not finite; every input is needed")
        sensors = windows[:, :, inputs:]
        if np.isinf(sensors).any():
            raise UnusableWindow(f"{channels[inputs + int(np.argwhere(np.isinf(sensors))[0][2])].name}: not finite")
        return windows


@dataclass(slots=True)
class OutputOnly:
    """Windows of a system without inputs: a free decay where that explains the window, ambient forces otherwise."""

    decay: Identifier
    ambient: AmbientIdentifier
    times: StageTimes = field(default_factory=StageTimes)

    @property
    def digest(self) -> str:
        """Names the model that made an estimate."""
        return self.ambient.digest

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """One `Estimate` per window; see `model.identifier.Identifies`."""
        found = self.decay.identify(windows, start, states=states)
        shaken = [b for b, estimate in enumerate(found) if not (estimate.adequate and estimate.identifiable.any())]
        again = self.ambient.identify(windows[shaken], None if start is None else start[shaken])
        for b, estimate in zip(shaken, again, strict=True):
            found[b] = estimate
        spent = self.decay.times.refine + (self.ambient.times.refine if shaken else 0.0)
        self.times = StageTimes(0.0, spent)
        return found


@dataclass(slots=True)
class Undistorted:
    """Windows without the faults of measurements that the system file states."""

    system: System
    inner: Identifies

    @property
    def digest(self) -> str:
        """Names the model that made an estimate."""
        return self.inner.digest

    @property
    def times(self) -> StageTimes:
        """Seconds of the last batch."""
        return self.inner.times

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """One `Estimate` per window; see `model.identifier.Identifies`."""
        return self.inner.identify(self.system.undistorted(windows), start, states=states)


def load_identifier(system: System, model: str | Path | None = None, workers: int = 1) -> Identifies:
    """The system's identifier with trained weights from `model` (a directory), or the bundled ones if they fit.

    Without weights for the system the refinement starts from the nominal values.  Systems on a track, or without any
    input, are identified from the spectra of their sensors (`model.ambient`), for which there is nothing to train.
    """
    if system.laws:
        return _with_laws(system, workers)
    if system.on_track:
        return AmbientIdentifier(system)
    if not system.file.inputs:
        return OutputOnly(Identifier(system, None, workers), AmbientIdentifier(system))
    estimator = load_estimator(model, system) if model is not None else bundled_estimator(system)
    return Identifier(system, estimator, workers)


def _with_laws(system: System, workers: int) -> Identifies:
    """The identifier around the laws of a system file.  Errors: `UnusableWindow` for a law that windows cannot hold."""
    if system.on_track or not system.file.inputs:
        raise UnusableWindow(f"{system.name}: laws can be tracked where the inputs are measured; leave them out")
    laws = acting_laws(system)
    if not laws:  # faults of measurements alone
        return Undistorted(system, Identifier(system, None, workers))
    linear = without_laws(system, laws)
    return Undistorted(system, IdentifierWithLaws(system, laws, Identifier(linear, None, workers), linear, workers))


def identifiability(system: System, seed: int = 0) -> FloatArray:
    """Standard deviation of each log-ratio that one simulated window gives at the nominal values, shape (P,).

    The median over 16 windows of running on an average track; `PRIOR_STD` where a window tells nothing.  Without
    measured inputs what the spectra of an unmeasured track, or of ambient forces, tell.
    """
    if not system.parameters:
        return np.zeros(0)
    if system.on_track or not system.file.inputs:
        return foreseen(system)
    truth = np.zeros((16, len(system.parameters)))
    runs = simulate_runs(system, truth, system.window, np.random.default_rng(seed))
    refined = Refiner(system).refine(runs.values, truth)
    std = np.sqrt(np.diagonal(refined.covariance, axis1=1, axis2=2))
    return np.minimum(np.median(std, axis=0), PRIOR_STD)


def _estimates(refined: Refined, states: bool) -> list[Estimate]:
    with np.errstate(divide="ignore", invalid="ignore"):
        per_sensor = np.where(refined.rms > 0, refined.error / refined.rms, np.nan)
    limit = 1 + _FIT_SIGMAS * np.sqrt(2 / np.maximum(refined.freedom, 1))
    fits = refined.chi_square < limit
    # A window that fits and yet pins nothing down tells nothing; nor does one whose inputs stand still, whatever moves.
    told = np.where(fits, refined.identifiable.any(axis=1) & refined.converged, True)
    informative = (refined.excitation > EXCITED) & told
    return [
        Estimate(
            log_ratio=refined.log_ratio[b],
            covariance=refined.covariance[b],
            identifiable=refined.identifiable[b],
            nrmse=pooled_nrmse(per_sensor[b]),
            per_sensor=per_sensor[b],
            chi_square=float(refined.chi_square[b]),
            adequate=bool(fits[b] and refined.converged[b]),
            converged=bool(refined.converged[b]),
            iterations=int(refined.iterations[b]),
            states=refined.states[b] if states else None,
            informative=bool(informative[b]),
        )
        for b in range(len(refined.log_ratio))
    ]


def pooled_nrmse(per_sensor: FloatArray) -> float:
    """rms over sensors of each sensor's error divided by its own rms; NaN sensors are absent."""
    shown = per_sensor[np.isfinite(per_sensor)]
    return float(np.sqrt(np.mean(shown**2))) if len(shown) else float("nan")
