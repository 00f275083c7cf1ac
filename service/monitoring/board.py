"""The latest of every vehicle, in memory: what metrics and pages show without asking the store."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.processed import Batch
from sprung.service.monitoring.views import VehicleView, beside_window, vehicle_view
from sprung.service.store.status import HEALTHS, without_numbers
from sprung.service.times import now_ns

OTHER = "other"
MOST_REASONS = 40  # of one vehicle, as labels of a metric


@dataclass(slots=True)
class Entry:
    """One vehicle: its view, and its windows since this process started."""

    view: VehicleView
    received_ns: int  # when the newest window came, by this machine's clock
    windows: Counter[str] = field(default_factory=lambda: Counter(used=0, repaired=0, dropped=0))
    reasons: Counter[str] = field(default_factory=Counter)  # of dropped windows

    @property
    def urgency(self) -> tuple[int, int]:
        """Larger needs attention first."""
        return HEALTHS.index(self.view.health), len(self.view.active)


class Board:
    """Bounded: of the vehicles that are well, those heard from longest ago are forgotten first (the store keeps them).

    A vehicle with an alarm is never forgotten, however many there are.
    """

    def __init__(self, engine: Engine, vehicles: int, clock: Callable[[], int] = now_ns) -> None:
        self._limit = vehicles
        self._clock = clock
        self._channels = {channel.name for channel in engine.system.channels}
        self._entries: OrderedDict[str, Entry] = OrderedDict()
        self._lock = threading.Lock()

    def on_batch(self, batch: Batch) -> None:
        """Take the outcome of a batch."""
        last = next((r for r in reversed(batch.records) if r.solved is not None), None)
        with self._lock:
            held = self._entries.get(batch.vehicle)
        if held is None and not batch.records:
            return
        if last is None and held is not None and held.view.model == batch.served.engine.digest:
            last = held.view.last
        engine = batch.served.engine
        made = batch.view or vehicle_view(engine, batch.vehicle, batch.state, last)
        view = beside_window(engine, made, last)
        with self._lock:
            entry = self._entries.setdefault(batch.vehicle, Entry(view, self._clock()))
            entry.view = view
            fresh = {window.start for window in batch.fresh}
            if fresh:
                entry.received_ns = self._clock()
            for record in batch.records:
                if record.start in fresh:
                    entry.windows[record.outcome] += 1
                    if record.outcome == "dropped":
                        entry.reasons[self._kind(entry, record.reason or "")] += 1
            self._entries.move_to_end(batch.vehicle)
            self._evict()

    def restore(self, views: list[tuple[VehicleView, int]]) -> None:
        """Fill an empty board from the store: views and when they were heard from, oldest first."""
        with self._lock:
            for view, received in views:
                self._entries[view.vehicle] = Entry(view, received)
            self._evict()

    def forget(self, vehicle: str) -> None:
        """A vehicle was deleted or taken out of service."""
        with self._lock:
            self._entries.pop(vehicle, None)

    def entries(self) -> list[Entry]:
        """Vehicles, the most urgent first, among equals the one heard from last."""
        with self._lock:
            newest_first = list(reversed(self._entries.values()))
        return sorted(newest_first, key=lambda entry: entry.urgency, reverse=True)

    def _evict(self) -> None:
        surplus = len(self._entries) - self._limit
        if surplus > 0:
            well = [vehicle for vehicle, entry in self._entries.items() if entry.view.health == "ok"]
            for vehicle in well[:surplus]:
                del self._entries[vehicle]

    def _kind(self, entry: Entry, reason: str) -> str:
        """A reason without channels and numbers: few enough for a label."""
        words = [word for word in without_numbers(reason).split() if word.strip(",;:") not in self._channels]
        kind = " ".join(words) or OTHER
        return kind if kind in entry.reasons or len(entry.reasons) < MOST_REASONS else OTHER
