"""Deviations taken back from the samples of windows: gains divided out, delays moved back, and how they add up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import make_interp_spline

from sprung.model.identification.measurements.deviations import Deviation, named
from sprung.model.signals import FloatArray, IntArray, MeasurementFault
from sprung.model.system import System

MARGIN = 2  # samples that a delay costs at either end beyond itself
_DEAF = 0.9  # away from 1: a channel whose gain is nearly none shows noise, and its gain could be anything
_SET_ANEW = 0.2  # of a window: what is left once a delay is taken back from both ends is still informative


class Corrections:
    """Gains and delays of the channels of one system as points over its deviations, and what they make of windows."""

    def __init__(self, system: System, samples: int, deviations: Sequence[Deviation]) -> None:
        """samples: of windows; deviations: H of them, the gains of all C channels first, then their delays."""
        self.deviations = deviations
        self.channels = len(system.channels)
        self.names = [channel.name for channel in system.channels]
        self.rate = system.sample_rate
        self.longest = _SET_ANEW * samples / system.sample_rate  # s, of delays that are taken back
        self.measured = np.arange(len(deviations)) < 2 * self.channels  # gains and delays, shape (H,)

    def points(self, known: Sequence[tuple[MeasurementFault, ...]], windows: int) -> FloatArray:
        """The gains and delays among what is known of each of some windows as deviations, (B, H)."""
        C, points = self.channels, np.zeros((windows, len(self.deviations)))
        made: dict[tuple[MeasurementFault, ...], FloatArray] = {}
        for b, faults in enumerate(known):
            if faults not in made:
                made[faults] = np.zeros(len(self.deviations))
                for fault in faults:
                    columns = [self.names.index(name) for name in fault.channel.split("|")]
                    if fault.kind == "gain":
                        made[faults][columns] = fault.value - 1
                    elif fault.kind == "delay":
                        made[faults][C + np.array(columns)] = fault.value
            points[b] = made[faults]
        return points

    def margin(self, point: FloatArray) -> IntArray:
        """Samples at either end that delays taken back (B, H) leave nothing right of, (B,)."""
        C = self.channels
        late = np.abs(point[:, C : 2 * C]).max(axis=1, initial=0.0) * self.rate
        return np.where(late > 0, np.ceil(late).astype(np.int64) + MARGIN, 0)

    def corrected(self, windows: FloatArray, point: FloatArray) -> FloatArray:
        """Windows (B, T, C) with gains divided out and delays taken back; at the ends a delay leaves nothing right."""
        C = self.channels
        out = windows / (1 + point[:, None, :C])
        time = np.arange(windows.shape[1]) / self.rate
        for c in np.flatnonzero(point[:, C : 2 * C].any(axis=0)).tolist():
            late = point[:, C + c]
            whole = np.isfinite(out[:, :, c]).all(axis=1) & (np.ptp(out[:, :, c], axis=1) > 0)  # frozen ones stay so
            for size in np.unique(late[whole & (late != 0)]):
                rows = np.flatnonzero(whole & (late == size))
                at = np.clip(time + size, 0, time[-1])
                out[rows, :, c] = make_interp_spline(time, out[rows, :, c].T, k=7)(at).T
        return np.asarray(out)

    def moved(self, point: FloatArray, step: FloatArray) -> FloatArray:
        """Deviations (H,) with a step (H,) taken on top of them: gains multiply, all else adds."""
        C = self.channels
        out = point + step
        out[:C] = (1 + point[:C]) * (1 + step[:C]) - 1
        return out

    def credible(self, point: FloatArray) -> bool:
        """Whether gains and delays are such as a window can still determine."""
        gains, delays = np.abs(point[: 2 * self.channels]).reshape(2, -1)
        return bool(gains.max() < _DEAF and delays.max() < self.longest)

    def named(self, point: FloatArray) -> tuple[MeasurementFault, ...]:
        """Gains and delays among deviations (H,) as faults of channels."""
        return named(self.deviations, point, np.zeros(len(point)), np.abs(point) > 0)
