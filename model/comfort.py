"""Ride comfort and running behaviour per minute, from vertical accelerometers on the body.

- EN 12299 / ISO 2631-4: accelerations weighted by W_b, rms of 5 s; N_MV = 6 times their 95th percentile over at least
  5 min where all three axes are measured.  Here only its vertical part.
- ISO 2631-1: rms weighted by W_k.
- EN 14363, simplified method: band-pass 0.4-10 Hz, the 0.15th and 99.85th percentiles and the rms.

Weightings are applied in the frequency domain: a digital filter at 100 Hz cannot have the analogue one's 100 Hz edge.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.response import Responses
from sprung.model.ambient.sensing import sensing
from sprung.model.schema import MotionSensor, SupportInput
from sprung.model.signal_filters import analog_bandpass
from sprung.model.signals import FloatArray
from sprung.model.system import System

BLOCK = 5.0  # s, of one rms (EN 12299)
MINUTE = 60.0  # s, of one report
LEAD = 5.0  # s before a minute in which the weighting's transient dies away
ENOUGH_BLOCKS = 60  # of 5 s, for a mean comfort value
PERCENTILES = (0.15, 99.85)  # EN 14363
BAND = (0.4, 10.0)  # Hz, EN 14363
ROUGHNESS = 2.741619e-7  # b0 of ERRI B176, low level, for the effect of changes of the vehicle
OMEGA = 2 * np.pi * np.geomspace(0.1, 50.0, 600)  # rad/s


@dataclass(frozen=True, slots=True)
class Weighting:
    """A frequency weighting of ISO 2631 / ISO 8041: band limit, acceleration-velocity transition, upward step."""

    f3: float  # Hz, of the transition; f4 is the same
    q4: float
    f5: float  # Hz, where the upward step begins
    q5: float
    f6: float  # Hz, where it ends
    q6: float
    gain: float

    def __call__(self, omega: FloatArray) -> np.ndarray:
        """Complex response at angular frequencies, rad/s."""
        s = 1j * omega
        w1, w2, w3, w5, w6 = (2 * np.pi * f for f in (0.4, 100.0, self.f3, self.f5, self.f6))
        band = s**2 / (s**2 + np.sqrt(2) * w1 * s + w1**2) * w2**2 / (s**2 + np.sqrt(2) * w2 * s + w2**2)
        transition = (1 + s / w3) / (1 + s / (self.q4 * w3) + (s / w3) ** 2)
        step = (s**2 + w5 * s / self.q5 + w5**2) / (s**2 + w6 * s / self.q6 + w6**2)
        return np.asarray(self.gain * band * transition * step)


W_K = Weighting(12.5, 0.63, 2.37, 0.91, 3.35, 0.91, 1.0)  # ISO 2631-1, seated, vertical
W_B = Weighting(16.0, 0.55, 2.5, 0.9, 4.0, 0.95, 1.024)  # ISO 2631-4, EN 12299


def running_band(omega: FloatArray) -> np.ndarray:
    """Band-pass of EN 14363 for accelerations in the body, 24 dB per octave, at angular frequencies (F,), rad/s."""
    low, high = BAND
    return analog_bandpass(4, 2 * np.pi * low, 2 * np.pi * high, omega)


def weighted(values: FloatArray, rate: float, weighting: Callable[[np.ndarray], np.ndarray]) -> FloatArray:
    """Signals (T, S) through a response over frequency; zeros before and after."""
    size = len(values) + round(LEAD * rate)
    spectrum = np.fft.rfft(values, size, axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(size, 1 / rate)
    return np.asarray(np.fft.irfft(spectrum * weighting(omega)[:, None], size, axis=0)[: len(values)])


@dataclass(frozen=True, slots=True)
class Minute:
    """A minute of body accelerometers, each quantity of shape (S,), m/s^2."""

    start: int  # ns since epoch
    blocks: FloatArray  # rms of 5 s weighted by W_b, shape (12, S)
    wk: FloatArray  # rms weighted by W_k
    peak: FloatArray  # larger of the 0.15th and 99.85th percentile in 0.4-10 Hz
    rms: FloatArray  # in 0.4-10 Hz


def minute(values: FloatArray, rate: float, start: int) -> Minute:
    """Of accelerations (T, S) whose first `LEAD` seconds come before the minute that starts at `start`."""
    values = values - values.mean(axis=0)
    lead = round(LEAD * rate)
    wb, wk, band = (weighted(values, rate, w)[lead:] for w in (W_B, W_K, running_band))
    length = round(BLOCK * rate)
    pieces = wb[: len(wb) // length * length].reshape(-1, length, wb.shape[1])
    low, high = np.percentile(band, PERCENTILES, axis=0)
    return Minute(
        start=start,
        blocks=np.sqrt((pieces**2).mean(axis=1)),
        wk=np.sqrt((wk**2).mean(axis=0)),
        peak=np.maximum(-low, high),
        rms=np.sqrt((band**2).mean(axis=0)),
    )


def comfort_sensors(system: System) -> tuple[int, ...]:
    """Indices of the accelerometers on bodies on which nothing stands: where people are."""
    carrying = {element.lower for element in system.file.elements.values()}
    return tuple(
        i
        for i, sensor in enumerate(system.file.sensors.values())
        if isinstance(sensor, MotionSensor) and sensor.kind == "acceleration" and sensor.body not in carrying
    )


class RideQuality:
    """Collects minutes from windows that overlap, in the order of their times; gaps begin a new minute."""

    def __init__(self, system: System, most: int | None = None) -> None:
        """most: minutes that are kept, the latest; None: all."""
        self.rate = system.sample_rate
        self.sensors = comfort_sensors(system)
        self.columns = [len(system.inputs) + i for i in self.sensors]
        self.names = tuple(system.sensors[i] for i in self.sensors)
        self.minutes: deque[Minute] = deque(maxlen=most)
        self._held = np.empty((0, len(self.columns)))
        self._next: int | None = None  # ns, of the sample that continues the held ones

    def push(self, start: int, values: FloatArray) -> None:
        """The window (T, C) that starts at `start`, ns; an absent sensor stays absent for that minute."""
        if not self.columns:
            return
        step = 1e9 / self.rate
        known = 0 if self._next is None else round((self._next - start) / step)
        if self._next is None or known < 0:
            self._held, known = self._held[:0], 0
        fresh = values[known:, self.columns]
        if len(fresh) == 0:
            return
        self._held = np.concatenate([self._held, fresh])
        self._next = start + round(len(values) * step)
        whole, lead = round((LEAD + MINUTE) * self.rate), round(LEAD * self.rate)
        while len(self._held) >= whole:
            began = self._next - round((len(self._held) - lead) * step)
            self.minutes.append(minute(self._held[:whole], self.rate, began))
            self._held = self._held[whole - lead :]

    def by_minute(self) -> list[tuple[int, dict[str, dict[str, float | None]]]]:
        """Start, ns, and quantities by sensor, m/s^2, of every minute."""
        return [
            (
                m.start,
                {
                    name: {
                        "wb_rms": _number(np.sqrt(np.mean(m.blocks[:, i] ** 2))),
                        "wk_rms": _number(m.wk[i]),
                        "en14363_peak": _number(m.peak[i]),
                        "en14363_rms": _number(m.rms[i]),
                    }
                    for i, name in enumerate(self.names)
                },
            )
            for m in self.minutes
        ]

    def summary(self) -> dict[str, object]:
        """What a ride was like, sensor by sensor; None where there is too little of it, or no sensor."""
        if not self.minutes:
            return {"minutes": 0, "sensors": {}}
        blocks = np.concatenate([m.blocks for m in self.minutes])
        p95 = np.percentile(blocks, 95, axis=0)
        wk = np.sqrt(np.mean([m.wk**2 for m in self.minutes], axis=0))
        peak = np.max([m.peak for m in self.minutes], axis=0)
        rms = np.sqrt(np.mean([m.rms**2 for m in self.minutes], axis=0))
        by_sensor = {
            name: {
                "wb_p95": _number(p95[i]),
                "n_mv_vertical": _number(6 * p95[i]) if len(blocks) >= ENOUGH_BLOCKS else None,
                "wk_rms": _number(wk[i]),
                "en14363_peak": _number(peak[i]),
                "en14363_rms": _number(rms[i]),
            }
            for i, name in enumerate(self.names)
        }
        return {"minutes": len(self.minutes), "sensors": by_sensor}


def foreseen(system: System, log_ratio: FloatArray, speed: float = 40.0) -> FloatArray:
    """W_b-weighted rms at the comfort sensors (S,), m/s^2, on an average track at `speed`, m/s, for given parameters.

    All wheels of a side see one profile, after ERRI B176, and the sides are alike by half.  Values of laws behind those
    of the linear parameters are left out: what is foreseen is the linear vehicle.
    """
    log_ratio = log_ratio[: len(system.parameters)]
    at = np.array(comfort_sensors(system))
    supports = [name for name, source in system.file.inputs.items() if source.kind != "force"]
    if len(at) == 0 or not supports:
        return np.zeros(0)
    place = np.array([_place(system, name) for name in supports])
    wave = OMEGA / speed
    density = ROUGHNESS / (wave**4 + 0.6803895 * wave**2 + 0.00028855) / speed  # m^2 per rad/s
    alike = np.where(np.sign(place[:, None, 1]) == np.sign(place[None, :, 1]), 1.0, 0.5)
    sources = alike * np.exp(1j * wave[:, None, None] * (place[:, None, 0] - place[None, :, 0]))
    sensed = sensing(system.mechanics, at, np.ones(len(at)))
    rows = sensed.rows.T @ Responses(system, sensed).at(log_ratio, OMEGA).signals
    power = np.einsum("fsx,fxy,fsy->fs", rows, sources, rows.conj(), optimize=True).real
    return np.asarray(np.sqrt(np.trapezoid(power * (density * np.abs(W_B(OMEGA)) ** 2)[:, None], OMEGA, axis=0)))


def cost(system: System, log_ratio: FloatArray, baseline: FloatArray, speed: float = 40.0) -> float | None:
    """Relative change of the W_b-weighted rms, mean over the comfort sensors, that leaving the baseline has brought.

    Both as log-ratios (P,); speed in m/s.
    """
    now, then = (foreseen(system, values, speed) for values in (log_ratio, baseline))
    return float(np.mean(now) / np.mean(then) - 1) if len(now) else None


def _place(system: System, support: str) -> tuple[float, float]:
    """Where a support stands: its own position, or that of an element on it."""
    source = system.file.inputs[support]
    if not isinstance(source, SupportInput) and source.position is not None:
        return source.position
    for element in system.file.elements.values():
        if support in (element.upper, element.lower) and element.position is not None:
            return element.position
    return (0.0, 0.0)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
