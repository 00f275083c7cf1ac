"""Windows of a recording without measured inputs, each with parameters and goodness of fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.identify import AmbientIdentifier, as_estimate
from sprung.model.ambient.rules import AmbientWindowRules
from sprung.model.ambient.sensing import sensing
from sprung.model.ambient.transient import TransientWindow
from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.rules import AmbientRules, Rules
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Powers:
    """Power of S sensors in parts of the band."""

    frequency: FloatArray  # Hz, (F,)
    whole: FloatArray  # (F, S)
    rest: FloatArray  # without the transients of the window's ends, (F, S)
    expected: FloatArray  # of the rest, by the model, (F, S)
    count: FloatArray  # degrees of freedom of every bin, (F,)


@dataclass(frozen=True)
class WindowResult:
    """One window."""

    begin: float  # s
    end: float
    log_ratio: FloatArray  # (P,)
    covariance: FloatArray  # (P, P)
    adequate: bool
    powers: Powers

    @property
    def middle(self) -> float:
        return 0.5 * (self.begin + self.end)


class ShakenStructure:
    """Windows of a structure under unmeasured forces."""

    def __init__(self, system: System, signals: Signals, rules: AmbientWindowRules) -> None:
        self.system, self.signals, self.window = system, signals, TransientWindow(system, rules)
        self.rules = rules

    def result(self, start: int, stop: int, known: FloatArray | None) -> WindowResult | None:
        """Result of a window of samples; with `known` log-ratios (P,) only force levels are fitted."""
        fit = self.window.fit(self.signals.sensors[start:stop], self.signals.sensor_index, None, known)
        if fit is None:
            return None
        P = len(self.system.parameters)
        powers = Powers(fit.frequency, fit.whole, fit.rest, fit.expected, np.ones(len(fit.frequency)))
        at = times(self.signals, start, stop)
        return WindowResult(*at, fit.fitted.x[:P], fit.covariance[:P, :P], fit.adequate, powers)


class UnmeasuredTrack:
    """Windows of a vehicle on an unmeasured track."""

    def __init__(self, system: System, signals: Signals, rules: AmbientWindowRules) -> None:
        self.system, self.signals, self.identifier = system, signals, AmbientIdentifier(system, rules)
        self.rules = rules

    def result(self, start: int, stop: int, known: FloatArray | None) -> WindowResult | None:
        """Result of a window of samples; `known` is ignored: its parameters are always fitted."""
        system, sensors = self.system, self.signals.sensor_index
        window = np.full((stop - start, len(system.channels)), np.nan)
        window[:, : len(system.inputs)] = self.signals.speed[start:stop]
        window[:, len(system.inputs) + sensors] = self.signals.sensors[start:stop]
        fit = self.identifier.fit(window)
        if fit is None:
            return None
        present = np.isin(np.arange(len(system.sensors)), sensors)
        estimate = as_estimate(fit, len(system.parameters), present, self.rules)
        sensed = sensing(system.mechanics, sensors, system.sensor_noise[sensors])
        back = np.linalg.pinv(sensed.rows)
        seen = np.einsum("sr,frt,st->fs", back, sensed.seen(fit.spectra.matrix), back).real
        expected = np.einsum("sr,frt,st->fs", back, fit.fitted.at.covariance, back).real
        powers = Powers(fit.spectra.frequency, seen, seen, expected, fit.spectra.weight)
        at = times(self.signals, start, stop)
        return WindowResult(*at, estimate.log_ratio, estimate.covariance, estimate.adequate, powers)


def times(signals: Signals, start: int, stop: int) -> tuple[float, float]:
    """Of samples, s since the recording began."""
    return signals.start + start / signals.sample_rate, signals.start + stop / signals.sample_rate


def stretches(system: System, signals: Signals, rules: AmbientRules) -> tuple[list[tuple[int, int]], str]:
    """First and last samples of half-overlapping windows, and omitted parts in words."""
    length = min(system.window, signals.samples)
    hop = max(1, length // 2)
    starts = list(range(0, signals.samples - length + 1, hop))
    most = rules.windows_track if system.on_track else rules.windows
    note = ""
    if len(starts) > most:
        chosen = np.unique(np.round(np.linspace(0, len(starts) - 1, most)).astype(int))
        note = (
            f"looked at {len(chosen)} windows of {length / signals.sample_rate:g} s spread over the recording, "
            f"of {len(starts)}: more would say the same more exactly"
        )
        starts = [starts[i] for i in chosen]
    return [(start, start + length) for start in starts], note


@dataclass(frozen=True)
class _Remembering:
    """Cache of windows."""

    looked: ShakenStructure | UnmeasuredTrack
    memory: FitMemory

    def result(self, start: int, stop: int, known: FloatArray | None) -> WindowResult | None:
        sensors = np.ascontiguousarray(self.looked.signals.sensors[start:stop])
        fixed = None if known is None else known.tobytes()
        key = (type(self.looked), self.looked.rules, start, sensors.tobytes(), fixed)
        return self.memory.recall(key, lambda: self.looked.result(start, stop, known))


def all_windows(
    system: System, signals: Signals, rules: Rules, memory: FitMemory, progress: Progress
) -> tuple[list[WindowResult], str]:
    """All informative windows, and omitted parts in words."""
    kind = UnmeasuredTrack if system.on_track else ShakenStructure
    looked = _Remembering(kind(system, signals, rules.ambient_window), memory)
    cuts, note = stretches(system, signals, rules.ambient)
    found = []
    for number, (start, stop) in enumerate(cuts):
        progress(number / len(cuts))
        result = looked.result(start, stop, None)
        if result is not None:
            found.append(result)
    return found, note


def with_known(
    system: System,
    signals: Signals,
    windows: list[WindowResult],
    known: FloatArray,
    rules: AmbientWindowRules,
    memory: FitMemory,
) -> list[WindowResult]:
    """The same windows with common parameters (P,)."""
    if system.on_track:
        return windows
    looked, again = _Remembering(ShakenStructure(system, signals, rules), memory), []
    for window in windows:
        start, stop = (round((at - signals.start) * signals.sample_rate) for at in (window.begin, window.end))
        result = looked.result(start, stop, known)
        if result is not None:
            again.append(result)
    return again


def displaced(windows: list[WindowResult], parts: int) -> tuple[FloatArray, FloatArray, tuple[float, float]]:
    """Share of every sensor's power at other frequencies than the model's, (S,), its value under random errors, (S,).

    Third, the band with most of it, Hz.  parts: number of bands in which powers are compared.
    """
    frequency = windows[0].powers.frequency
    edges = np.linspace(frequency[0], frequency[-1] * (1 + 1e-9), min(parts, max(1, len(frequency) // 4)) + 1)
    sensors = windows[0].powers.whole.shape[1]
    apart, chance = np.zeros((len(edges) - 1, sensors)), np.zeros((len(edges) - 1, sensors))
    whole = np.zeros(sensors)
    for window in windows:
        powers = window.powers
        place = np.clip(np.digitize(powers.frequency, edges) - 1, 0, len(edges) - 2)
        np.add.at(apart, place, powers.count[:, None] * (powers.rest - powers.expected))
        np.add.at(
            chance, place, powers.count[:, None] * powers.rest**2 / 2
        )  # periodogram bins are exponentially distributed
        whole += powers.count @ np.maximum(powers.whole, np.maximum(powers.rest, powers.expected))
    share = 0.5 * np.abs(apart) / np.maximum(whole, 1e-300)
    by_chance = 0.5 * np.sqrt(2 / np.pi * chance) / np.maximum(whole, 1e-300)
    worst = int(np.argmax(share.sum(axis=1)))
    return share.sum(axis=0), by_chance.sum(axis=0), (float(edges[worst]), float(edges[worst + 1]))


def independent(windows: list[WindowResult]) -> BoolArray:
    """Mask (W,) of windows without overlap."""
    chosen, last = np.zeros(len(windows), dtype=bool), -np.inf
    for i, window in enumerate(windows):
        if window.begin >= last - 1e-9:
            chosen[i], last = True, window.end
    return chosen
