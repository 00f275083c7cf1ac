"""Measured against simulated: what the identified model makes of the samples that are still held of a vehicle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import BoolArray, Estimate, FloatArray
from sprung.service.errors import NotFound
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.ring import Excerpt
from sprung.service.times import NANOSECONDS


@dataclass(frozen=True, slots=True)
class Compared:
    """One window."""

    start: int  # ns since epoch
    sample_rate: float  # Hz
    measured: FloatArray  # sensors, shape (T, S); NaN: absent
    simulated: FloatArray  # shape (T, S)
    estimate: Estimate


def newest_window(engine: Engine, excerpt: Excerpt | None, vehicle: str) -> tuple[int, FloatArray]:
    """Start and values (T, C) of the newest whole window that is held.  Raises NotFound where there is none."""
    if unmeasured(engine):
        raise NotFound(f"what moves {vehicle} is not measured, so there is nothing to simulate its sensors from")
    for start, values in reversed(list(whole_windows(engine, excerpt))):
        return start, values
    raise NotFound(f"no recent samples of {vehicle} are held; they are kept for a minute after they came")


def unmeasured(engine: Engine) -> bool:
    """Whether the system is identified from its sensors alone."""
    return engine.system.on_track or not engine.system.file.inputs


def whole_windows(engine: Engine, excerpt: Excerpt | None) -> Iterator[tuple[int, FloatArray]]:
    """Windows (T, C) one after the other, oldest first, counted back from the newest sample.

    Channels with a gap are absent.  None without any sensor, or without what the system needs of its inputs.
    """
    if excerpt is None or unmeasured(engine):
        return
    length, inputs = engine.system.window, len(engine.system.inputs)
    names = [channel.name for channel in engine.system.channels]
    needed = [[names.index(name) for name in some] for some in engine.system.needed]
    for first in range(len(excerpt.values) % length, len(excerpt.values) - length + 1, length):
        values = excerpt.values[first : first + length]
        whole: BoolArray = np.asarray(np.isfinite(values).all(axis=0))
        if whole[inputs:].any() and all(whole[columns].any() for columns in needed):
            values = np.where(whole, values, np.nan)
            yield excerpt.start + round(first * NANOSECONDS / excerpt.sample_rate), values


def compare(engine: Engine, start: int, values: FloatArray) -> Compared:
    """Identify one window (T, C) and simulate its sensors; for the thread of the numerics."""
    return compare_all(engine, [(start, values)])[0]


def compare_all(engine: Engine, windows: Sequence[tuple[int, FloatArray]]) -> list[Compared]:
    """Identify windows, starts and values (T, C), at once and simulate their sensors; as `compare`."""
    if not windows:
        return []
    values = np.stack([held for _, held in windows])  # shape (B, T, C)
    estimates, _ = engine.identify(values, states=True, loads=True)
    inputs, rate = len(engine.system.inputs), engine.system.sample_rate
    return [
        Compared(start, rate, held[:, inputs:], estimate.outputs, estimate)
        for (start, held), estimate in zip(windows, estimates, strict=True)
        if estimate.outputs is not None
    ]
