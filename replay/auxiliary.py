"""Auxiliary signals beside the windows: speed, temperature, pressures, at any rate.

They are not resampled: a window gets the mean of the samples within it, or else the latest one before it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.signals import FloatArray, IntArray, SampleBlock, Window

VALID = 60.0  # s for which the latest value is used
KEPT = 1_000_000  # samples of one signal at most, in case no window ever comes


class AuxiliaryMeans:
    """Separates the samples of auxiliary channels from a stream and adds their means to its windows."""

    def __init__(self, channels: int, auxiliary: int) -> None:
        """Auxiliary channels follow the `channels` of the windows."""
        self._first = channels
        self._done = 0  # ns, start of the last window
        self._held: list[tuple[IntArray, FloatArray]] = [
            (np.zeros(0, dtype=np.int64), np.zeros(0)) for _ in range(auxiliary)
        ]

    def keep(self, block: SampleBlock) -> SampleBlock:
        """The block without them."""
        if not self._held:
            return block
        own = block.channel < self._first
        if own.all():
            return block
        for index in range(len(self._held)):
            rows = (block.channel == self._first + index) & np.isfinite(block.value)
            if rows.any():
                time, value = self._held[index]
                time, value = np.concatenate([time, block.time[rows]]), np.concatenate([value, block.value[rows]])
                recent = time >= self._done - round(VALID * 1e9)
                self._held[index] = time[recent][-KEPT:], value[recent][-KEPT:]
        return SampleBlock(block.time[own], block.channel[own], block.value[own])

    def to(self, window: Window) -> Window:
        """The window with the means of auxiliary signals."""
        if not self._held:
            return window
        self._done = window.start
        begin, end = window.start, window.start + round(len(window.values) / window.sample_rate * 1e9)
        return replace(window, auxiliary=np.array([self._mean(*held, begin, end) for held in self._held]))

    def _mean(self, time: IntArray, value: FloatArray, begin: int, end: int) -> float:
        inside = (time >= begin) & (time < end)
        if inside.any():
            return float(value[inside].mean())
        before = (time < begin) & (time >= begin - round(VALID * 1e9))
        return float(value[before][-1]) if before.any() else float("nan")
