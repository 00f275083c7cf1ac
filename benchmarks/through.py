"""A drawn day of the generator through the product: windows, identification, tracker, in the order of time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from sprung.benchmarks.generator.running import run_day
from sprung.benchmarks.generator.timetable import Timetable
from sprung.benchmarks.generator.vehicle import Vehicle
from sprung.model.signals import Estimate, FloatArray
from sprung.model.tracking.tracker import TrackerState
from sprung.service.monitoring.engine import Engine

START = 1_790_000_000_000_000_000  # ns
TOGETHER = 64  # windows of one batch


@dataclass(frozen=True, slots=True)
class Moment:
    """One window and what is known after it."""

    time: float  # s, of its middle
    estimate: Estimate
    state: TrackerState
    used: bool  # by the tracker
    watched: bool  # used, or of no use at a time when what was known before holds, or the vehicle stands


def through(engine: Engine, vehicle: Vehicle, timetable: Timetable) -> Iterator[Moment]:
    """Every window of a day."""
    system, tracker = engine.system, engine.tracker
    rate, state = system.sample_rate, tracker.initial_state()
    for windows, begins in _windows(engine, vehicle, timetable):
        starts = [START + round(k / rate * 1e9) for k in begins]
        known = [tracker.known_faults(state)] * len(windows)
        found, _ = engine.identify(windows, starts=starts, known=known)
        for k, start, estimate in zip(begins, starts, found, strict=True):
            before, state = state, tracker.update(state, estimate, start)
            share = state.coverage.share
            watched = 0 < share >= before.coverage.share
            yield Moment((k + system.window / 2) / rate, estimate, state, state.used > before.used, watched)


def _windows(engine: Engine, vehicle: Vehicle, timetable: Timetable) -> Iterator[tuple[FloatArray, list[int]]]:
    """Batches (B, T, C) and the numbers of their first samples, as the day is made piece by piece."""
    system = engine.system
    columns = [vehicle.channels.index(c.name) for c in system.channels]
    size, hop = system.window, system.hop
    held, first = np.zeros((0, len(columns))), 0  # samples that are held, and the number of the first of them
    for piece in chain(run_day(vehicle, timetable), [None]):
        if piece is not None:
            held = np.vstack([held, piece[:, columns]])
        count = max((len(held) - size) // hop + 1, 0)
        for at in range(0, count, TOGETHER):
            chosen = range(at, min(at + TOGETHER, count))
            if len(chosen) < TOGETHER and piece is not None:
                count = at
                break
            yield np.stack([held[k * hop : k * hop + size] for k in chosen]), [first + k * hop for k in chosen]
        held, first = held[count * hop :], first + count * hop
