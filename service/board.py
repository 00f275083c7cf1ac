"""The latest of every vehicle, in memory: what metrics and pages show without asking the store."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from dataclasses import dataclass, field

from sprung.service.engine import Engine
from sprung.service.pipeline import Batch
from sprung.service.views import VehicleView, vehicle_view


@dataclass(slots=True)
class Entry:
    """One vehicle: its view, and its windows since this process started."""

    view: VehicleView
    windows: Counter[str] = field(default_factory=lambda: Counter(used=0, repaired=0, dropped=0))


class Board:
    """Bounded: the vehicles heard from longest ago are forgotten first (the store keeps them)."""

    def __init__(self, engine: Engine, vehicles: int) -> None:
        self._engine = engine
        self._limit = vehicles
        self._entries: OrderedDict[str, Entry] = OrderedDict()
        self._lock = threading.Lock()

    def on_batch(self, batch: Batch) -> None:
        """Take the outcome of a batch."""
        if not batch.records:
            return
        last = next((r for r in reversed(batch.records) if r.solved is not None), None)
        with self._lock:
            held = self._entries.get(batch.vehicle)
        if last is None and held is not None:
            last = held.view.last
        view = vehicle_view(self._engine, batch.vehicle, batch.state, last)
        with self._lock:
            entry = self._entries.setdefault(batch.vehicle, Entry(view))
            entry.view = view
            fresh = {window.start for window in batch.fresh}
            entry.windows.update(record.outcome for record in batch.records if record.start in fresh)
            self._entries.move_to_end(batch.vehicle)
            while len(self._entries) > self._limit:
                self._entries.popitem(last=False)

    def restore(self, views: list[VehicleView]) -> None:
        """Fill an empty board from the store, oldest first."""
        with self._lock:
            for view in views[-self._limit :]:
                self._entries[view.vehicle] = Entry(view)

    def entries(self) -> list[Entry]:
        """Vehicles, the one heard from last first."""
        with self._lock:
            return list(reversed(self._entries.values()))
