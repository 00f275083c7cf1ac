"""Two recordings, or a recording and a system file: how far apart they are, sensor by sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.simulate.begun import fitted_start
from sprung.model.simulate.ride import Ride, simulate_ride
from sprung.model.system import System, load_system
from sprung.replay.record import Record
from sprung.service.errors import UserError

SYSTEM_FILES = (".yaml", ".yml")
_LEAST = 32  # samples that both need


@dataclass(frozen=True, slots=True)
class Comparison:
    """Measured and simulated (or a second measurement) on one grid."""

    system: System
    names: tuple[str, str]  # of the two
    time: FloatArray  # s from the first common sample, shape (T,)
    measured: FloatArray  # shape (T, S), NaN where missing
    simulated: FloatArray  # shape (T, S)
    ride: Ride | None  # of a simulated system: motion and force of its elements

    @property
    def nrmse(self) -> FloatArray:
        """rms(error) / rms(measured) of every sensor, shape (S,); NaN for one that either lacks."""
        error = self.measured - self.simulated
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(_mean(error**2) / _mean(np.where(np.isfinite(error), self.measured, np.nan) ** 2))

    @property
    def pooled(self) -> float:
        """rms over sensors of their nrmse."""
        shown = self.nrmse[np.isfinite(self.nrmse)]
        return float(np.sqrt(np.mean(shown**2))) if len(shown) else float("nan")


def compare(measured: Path, other: Path, system: System, load: Callable[[Path], Record]) -> Comparison:
    """Lay a recording beside another one, or beside what a system file simulates on its inputs.

    load: reads a recording of the system's channels.
    Errors: `UserError` when they have nothing in common; the readers' own.
    """
    record = load(measured)
    if other.suffix.lower() in SYSTEM_FILES:
        return _against_system(record, load_system(other, system.catalogue), (measured.name, other.name))
    second = load(other)
    first, last, offset = _overlap(record, second, measured, other)
    inputs = len(system.inputs)
    return Comparison(
        system,
        (measured.name, other.name),
        np.arange(last - first) / system.sample_rate,
        record.values[first:last, inputs:],
        second.values[first - offset : last - offset, inputs:],
        None,
    )


def _against_system(record: Record, system: System, names: tuple[str, str]) -> Comparison:
    inputs = len(system.inputs)
    if record.values.shape[1] != len(system.channels):
        raise UserError(f"{names[1]}: has other channels than the system file that reads {names[0]}")
    whole = np.asarray(np.isfinite(record.values[:, :inputs]).all(axis=1))
    first, last = _longest(whole)
    if last - first < _LEAST:
        raise UserError(f"{names[0]}: no stretch of {_LEAST} samples with every input")
    driven, measured = record.values[first:last, :inputs], record.values[first:last, inputs:]
    ride = simulate_ride(system, driven, start=fitted_start(system, driven, measured))
    time = np.arange(last - first) / system.sample_rate
    return Comparison(system, names, time, measured, ride.sensors, ride)


def _overlap(a: Record, b: Record, first: Path, second: Path) -> tuple[int, int, int]:
    """Rows of `a` that `b` has too, and the row of `a` at which `b` begins."""
    offset = round((b.start - a.start) * 1e-9 * a.sample_rate)
    begin, end = max(0, offset), min(len(a.values), offset + len(b.values))
    if end - begin < _LEAST:  # recorded at other times: laid beside each other from their starts
        offset, begin, end = 0, 0, min(len(a.values), len(b.values))
    if end - begin < _LEAST:
        raise UserError(f"{first}, {second}: at least {_LEAST} common samples are needed")
    return begin, end, offset


def _longest(good: np.ndarray) -> tuple[int, int]:
    """The longest run of True, as [first, last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return 0, 0
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(first), int(last)


def _mean(values: FloatArray) -> FloatArray:
    """Mean over time of what is there; NaN where nothing is."""
    present = np.isfinite(values)
    count = present.sum(axis=0)
    total = np.where(present, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
