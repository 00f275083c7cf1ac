"""Channels whose samples themselves show that they are frozen, saturated, noisy or silent."""

from __future__ import annotations

import numpy as np

from sprung.model.signals import FloatArray, MeasurementFault
from sprung.model.system import System

STUCK = ("frozen", "saturated", "noisy")  # refined without
_FLAT = 0.8  # share of equal neighbours beyond which a channel is frozen
_CLIPPED = 0.03  # share of samples at the very ends of the range, in runs, beyond which a channel is saturated
_ABOVE = 0.75  # of the band: there, vehicles hardly move, and a spectrum shows a channel's noise
_NOISY = 2.5  # times the noise of the file, and that of other channels of its unit; less hardly matters to a fit
_SHAKEN = 10.0  # deviations of its noise that a sensor moves by when the vehicle runs; doors and people stay below


class StuckChannels:
    """Of windows of one system."""

    def __init__(self, system: System) -> None:
        self.names = [channel.name for channel in system.channels]
        self.inputs = len(system.inputs)
        self.stated = np.array([channel.noise for channel in system.channels])
        self.noise = self.stated[self.inputs :]
        self.units = np.array([channel.unit for channel in system.channels])

    def channels(self, window: FloatArray) -> tuple[MeasurementFault, ...]:
        """Those of one window (T, C) that are frozen or saturated."""
        found = []
        for name, samples in zip(self.names, window.T, strict=True):
            if not np.isfinite(samples).all():
                continue
            if np.mean(np.diff(samples) == 0) > _FLAT:
                found.append(MeasurementFault(name, "frozen", float(samples[-1])))
                continue
            for end in (samples.max(), samples.min()):
                there = samples == end
                if there.mean() > _CLIPPED and np.any(there[2:] & there[1:-1] & there[:-2]):
                    found.append(MeasurementFault(name, "saturated", float(end)))
                    break
        return tuple(found)

    def noisy(self, window: FloatArray) -> tuple[MeasurementFault, ...]:
        """Those of one window (T, C) that alone of their unit show more noise than the file states.

        Not those that have no other of their unit beside them: friction and stops reach as high as noise does.
        """
        taper = np.hanning(len(window) + 2)[1:-1]
        spectrum = np.fft.rfft((window - window.mean(axis=0)) * taper[:, None], axis=0)
        high = np.abs(spectrum[round(_ABOVE * len(spectrum)) :]) ** 2
        std = np.sqrt(high.mean(axis=0) / (taper**2).sum())
        ratio = std / np.maximum(self.stated, 1e-300)
        found = []
        for c in np.flatnonzero(ratio > _NOISY).tolist():
            others = (self.units == self.units[c]) & np.isfinite(ratio) & (np.arange(len(ratio)) != c)
            if others.any() and ratio[c] > _NOISY * np.median(ratio[others]):
                found.append(MeasurementFault(self.names[c], "noisy", float(f"{std[c]:.2g}")))
        return tuple(found)

    def silent(self, window: FloatArray) -> tuple[MeasurementFault, ...]:
        """Those of one window (T, C) of which nothing came."""
        absent = np.flatnonzero(np.isnan(window).any(axis=0))
        return tuple(MeasurementFault(self.names[column], "silent", 0.0) for column in absent)

    def all_inputs(self, window: FloatArray) -> tuple[MeasurementFault, ...]:
        """Whether all inputs of one window (T, C), of those that came, are frozen although most sensors show that the
        vehicle runs: one fault of them all, since what froze them is what they share.

        At a standstill inputs may be as flat, where steps of the converter are coarse, but then sensors are quiet.
        """
        there = np.flatnonzero(np.isfinite(window[:, : self.inputs]).all(axis=0))
        flat = np.mean(np.diff(window[:, there], axis=0) == 0, axis=0) > _FLAT
        if len(there) == 0 or not flat.all():
            return ()
        moves = window[:, self.inputs :].std(axis=0) > _SHAKEN * self.noise  # one that is absent is NaN and does not
        if np.count_nonzero(moves) <= len(moves) / 2:
            return ()
        return (MeasurementFault("|".join(self.names[c] for c in there), "frozen", float(window[-1, there[0]])),)
