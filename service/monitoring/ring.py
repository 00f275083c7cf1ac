"""The last minute of a vehicle's aligned samples, kept so that a mismatch can be looked into when it shows."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import FloatArray, Window
from sprung.service.monitoring.places import Places
from sprung.service.times import NANOSECONDS


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Samples on one even grid; NaN where nothing whole was received."""

    start: int  # ns since epoch
    sample_rate: float  # Hz
    values: FloatArray  # shape (T, C)


class Ring:
    """Recent samples of one vehicle, written window by window (overlaps fall on themselves)."""

    def __init__(self, samples: int, channels: int, sample_rate: float) -> None:
        self._values = np.full((samples, channels), np.nan)
        self._rate = sample_rate
        self._origin = 0  # time of grid index 0, ns since epoch
        self._end: int | None = None  # grid index after the newest sample

    def add(self, window: Window) -> None:
        """Take the samples of a window that was used or repaired; older than the ring is ignored."""
        samples = len(self._values)
        if self._end is None:
            self._origin = window.start
        first = round((window.start - self._origin) * self._rate / NANOSECONDS)
        last = first + len(window.values)
        if self._end is None or first >= self._end + samples:
            self._values[:] = np.nan
        elif last <= self._end - samples:
            return
        elif first > self._end:  # a gap: what was there a turn ago is not from now
            self._values[np.arange(self._end, first) % samples] = np.nan
        rows = np.arange(max(first, last - samples), last)
        self._values[rows % samples] = window.values[rows - first]
        self._end = max(last, self._end or last)

    def excerpt(self) -> Excerpt | None:
        """What is held, oldest first, without the part that was never filled; None when nothing is held."""
        if self._end is None:
            return None
        samples = len(self._values)
        rows = np.arange(self._end - samples, self._end)
        values = self._values[rows % samples]
        filled = np.flatnonzero(~np.all(np.isnan(values), axis=1))
        if len(filled) == 0:
            return None
        first = int(filled[0])
        start = self._origin + round((int(rows[0]) + first) * NANOSECONDS / self._rate)
        return Excerpt(start, self._rate, values[first:].copy())


class Rings:
    """Rings of as many vehicles as there is room for, see `Places`."""

    def __init__(self, vehicles: int, seconds: float, channels: int, sample_rate: float) -> None:
        self._shape = (max(1, round(seconds * sample_rate)), channels, sample_rate)
        self._rings: Places[Ring] = Places(vehicles, seconds)
        self._lock = threading.Lock()

    def add(self, vehicle: str, windows: list[Window], urgent: bool = False) -> None:
        """Take a vehicle's windows; urgent: something is wrong with it."""
        with self._lock:
            ring = self._rings.heard(vehicle, lambda: Ring(*self._shape), urgent)
            if ring is None:
                return
            for window in windows:
                if window.outcome != "dropped" and len(window.values):  # without: the samples stayed on board
                    ring.add(window)

    def excerpt(self, vehicle: str) -> Excerpt | None:
        """What is held of a vehicle."""
        with self._lock:
            ring = self._rings.get(vehicle)
            return None if ring is None else ring.excerpt()
