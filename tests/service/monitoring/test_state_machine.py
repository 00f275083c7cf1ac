"""Windowing, tracker and store together, driven at random: whatever comes, in whatever order, the books agree."""

from __future__ import annotations

import json
import shutil
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from sprung.model.signals import SampleBlock
from sprung.model.system import MANCHESTER_DBC, load_system
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.sources.reading import windower_of
from sprung.service.store import Store, open_store
from tests.service_fakes import START, FakeIdentifier

SYSTEM = load_system()
PERIOD = round(1e9 / SYSTEM.sample_rate)
CHANNELS = len(SYSTEM.channels)
VEHICLES = st.sampled_from(["a", "b"])


def block(first: int, rows: int, level: float, missing: int | None = None) -> SampleBlock:
    """`rows` samples of every channel from row `first` on, without one channel."""
    time = START + (first + np.arange(rows)) * PERIOD
    keep = [channel for channel in range(CHANNELS) if channel != missing]
    return SampleBlock(
        np.repeat(time, len(keep)), np.tile(np.array(keep), rows), np.full(rows * len(keep), level)
    )  # fmt: skip


class Books(RuleBasedStateMachine):
    """Rides of two vehicles, given whole, twice, late, with gaps, and across restarts of the service."""

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.compute = Compute(queue_size=4)
        self.rows = {"a": 0, "b": 0}  # how far each vehicle's rides have come
        self.given: dict[str, dict[int, str]] = {"a": {}, "b": {}}  # start of a window: outcome when it was given first
        self.last: dict[str, list[Any]] = {"a": [], "b": []}
        self._open()

    def _open(self) -> None:
        self.store: Store = open_store(f"sqlite:///{Path(self.folder.name) / 's.db'}")
        engine = Engine(SYSTEM, FakeIdentifier(SYSTEM), make_tracker(SYSTEM), MANCHESTER_DBC)
        self.pipeline = Pipeline(engine, self.store, self.compute)

    def _state(self, vehicle: str) -> str:
        """Of the vehicle's tracker, to the last bit (an array with a NaN is never equal to itself)."""
        return json.dumps(self.pipeline.state(vehicle).to_dict(), sort_keys=True)

    def _give(self, vehicle: str, windows: list[Any]) -> None:
        fresh = [window for window in windows if window.start not in self.given[vehicle]]
        for window in windows:
            self.given[vehicle].setdefault(window.start, window.outcome)
        if windows:
            batch = self.pipeline.process(vehicle, windows)
            assert len(batch.fresh) == len(fresh)

    @rule(
        vehicle=VEHICLES,
        seconds=st.integers(1, 4),
        level=st.floats(-0.5, 0.5),
        pause=st.integers(0, 300),
        gap=st.none() | st.integers(0, CHANNELS - 1),
        pieces=st.integers(1, 5),
    )
    def ride(self, vehicle: str, seconds: int, level: float, pause: int, gap: int | None, pieces: int) -> None:
        """A ride after the last one, in blocks of any size."""
        windower = windower_of(SYSTEM)
        first, rows = self.rows[vehicle] + pause, seconds * SYSTEM.window
        cuts = np.linspace(0, rows, pieces + 1).astype(int)
        windows = []
        for start, end in pairwise(cuts):
            if end > start:
                windows += windower.push(block(first + start, end - start, level, gap if start else None))
        windows += windower.flush()
        assert [window.start for window in windows] == sorted({window.start for window in windows})
        assert all(window.values.shape == (SYSTEM.window, CHANNELS) for window in windows)
        self.rows[vehicle] = first + rows
        self.last[vehicle] = windows
        self._give(vehicle, windows)

    @rule(vehicle=VEHICLES)
    def again(self, vehicle: str) -> None:
        """The last ride once more: nothing changes."""
        before = self._state(vehicle) if self.last[vehicle] else None
        self._give(vehicle, self.last[vehicle])
        if before is not None:
            assert self._state(vehicle) == before

    @rule(vehicle=VEHICLES, level=st.floats(-0.5, 0.5))
    def late(self, vehicle: str, level: float) -> None:
        """A ride from before everything that was tracked: it is stored and does not turn the tracker back."""
        if not self.given[vehicle] or self.pipeline.state(vehicle).time is None:
            return
        windower = windower_of(SYSTEM)
        first = -SYSTEM.window * (2 + 2 * len(self.given[vehicle]))
        windows = [*windower.push(block(first, SYSTEM.window, level)), *windower.flush()]
        before = self._state(vehicle)
        self._give(vehicle, windows)
        assert self._state(vehicle) == before

    @rule(closed=st.booleans())
    def restart(self, closed: bool) -> None:
        """The service ends, in good order or not, and begins again; it knows what it knew."""
        before = {vehicle: self._state(vehicle) for vehicle, given in self.given.items() if given}
        if closed:
            self.store.close()
        else:  # what is on the disk while the store is open is all that a kill leaves: write-ahead log included
            left = tempfile.TemporaryDirectory()
            shutil.copytree(self.folder.name, left.name, dirs_exist_ok=True)
            self.store.close()
            self.folder.cleanup()
            self.folder = left
        self._open()
        assert {vehicle: self._state(vehicle) for vehicle in before} == before

    @invariant()
    def the_store_holds_every_window_once(self) -> None:
        if not hasattr(self, "store"):
            return
        with self.store.read() as connection:
            rows = connection.exec_driver_sql("SELECT vehicle_id, start_ns, outcome, tracked FROM windows").fetchall()
            minutes = connection.exec_driver_sql(
                "SELECT vehicle_id, sum(windows) FROM rollups WHERE resolution_s = 60 GROUP BY vehicle_id"
            ).fetchall()
        stored = {(vehicle, start): outcome for vehicle, start, outcome, _ in rows}
        assert len(stored) == len(rows)
        assert stored == {(v, start): how for v, given in self.given.items() for start, how in given.items()}
        tracked = {vehicle: sum(bool(row[3]) for row in rows if row[0] == vehicle) for vehicle in self.given}
        assert {vehicle: count for vehicle, count in tracked.items() if count} == {v: n for v, n in minutes if n}

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            self.compute.close()
            self.folder.cleanup()


Books.TestCase.settings = settings(
    max_examples=6, stateful_step_count=8, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
TestBooks = Books.TestCase
