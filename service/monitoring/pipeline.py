"""Windows of one vehicle -> estimates -> tracker -> store: each window once, whoever brings it and however often."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
from cachetools import LRUCache
from sqlalchemy import Connection

from sprung.model.signals import Estimate, FloatArray, MeasurementFault, Window
from sprung.model.tracking.tracker import TrackerState
from sprung.service.monitoring.changes import OnAlarms, TrackerChange, keep_changes, keep_statuses, new_status
from sprung.service.monitoring.compute import Compute, Priority
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.engines import Engines, ServedModel
from sprung.service.monitoring.fair_queues import Pace
from sprung.service.monitoring.following import FollowedWindows, Following, follow
from sprung.service.monitoring.processed import (
    Batch,
    FaultsChanged,
    FoldedWindows,
    HeldVehicle,
    IdentifiedBatch,
    ModelChanged,
    Newcomer,
    WindowsToFold,
)
from sprung.service.monitoring.views import VehicleView, vehicle_view
from sprung.service.store import Store, fleet, status
from sprung.service.store.partitions import prepare
from sprung.service.store.vehicle_models import SERVICE_FILE
from sprung.service.store.windows import WindowRecord, known_windows, latest_window
from sprung.service.times import NANOSECONDS, now_ns

LEARNED_FROM = 30  # vehicles, whose slopes over weather a new one is told
FRESH_GROWTH, FRESH_NS = 1.1, 3600 * NANOSECONDS  # vehicles and time after which they are asked again
FORGET_BEYOND = 1000  # vehicles in memory when the settings do not say


class Pipeline:
    """Feeds windows through the model into the store.  Safe to share between threads and processes.

    engine, model_id: of the service's own system file; `engines` knows vehicles that have one of their own.
    """

    def __init__(
        self,
        engine: Engine,
        store: Store,
        compute: Compute,
        listeners: Sequence[Callable[[Batch], None]] = (),
        vehicles_in_memory: int = FORGET_BEYOND,
        clock: Callable[[], int] = now_ns,
        on_alarms: OnAlarms = lambda connection, vehicle, changes: None,
        staging: str | None = None,
        follow: Following = follow,
        beside: Compute | None = None,
    ) -> None:
        """on_alarms: called with alarms that open, change or close, inside the transaction that stores them.

        staging: digest under which everything is kept unseen (`service.store.staging`); follow: feeds windows to
        trackers; beside: for windows of vehicles with a model of their own, so that others never wait for a slow one.
        """
        self.engine = engine
        self.store = store
        self._compute = compute
        self._beside = beside or compute
        self.pace = Pace()
        self._listeners = listeners
        self._clock = clock
        self.aging = clock  # by which stored windows age; a service's is that of retention
        self._follow = follow
        self._on_alarms = on_alarms
        self._shown = staging is None
        self._vehicles: LRUCache[str, HeldVehicle] = LRUCache(vehicles_in_memory)
        self._last_newcomer: Newcomer | None = None
        self._lock = threading.Lock()
        with store.write() as connection:
            self.model_id = fleet.ensure_model(
                connection, staging or engine.digest, engine.system.name, engine.description(), clock()
            )
        self.engines = Engines(engine, self.model_id, own=staging is None)

    def compute_of(self, served: ServedModel) -> Compute:
        """Where the numerics of a vehicle's model are done."""
        return self._compute if served.version == SERVICE_FILE else self._beside

    def process(
        self,
        vehicle: str,
        windows: Sequence[Window],
        recording_id: str | None = None,
        priority: Priority = Priority.BATCH,
    ) -> Batch:
        """Identify, track and store windows; those that are stored already are read back instead.

        windows: in order of time.  Returns when the transaction is committed.
        """
        return self.keep(self.identify(vehicle, windows, priority), recording_id)

    def identify(
        self,
        vehicle: str,
        windows: Sequence[Window],
        priority: Priority = Priority.BATCH,
        faults: tuple[MeasurementFault, ...] | None = None,
    ) -> IdentifiedBatch:
        """The first half of `process`: may run while the batch before is still tracked and stored.

        faults: of the vehicle's measurements; None: as its tracker in memory knows them.
        """
        with self.store.read() as connection:
            served = self.engines.of(connection, vehicle)
            known = known_windows(connection, vehicle, served.model_id, [w.start for w in windows])
        fresh = [w for w in windows if w.start not in known]
        if faults is None:
            faults = self.known_faults(vehicle, served)
        estimates, seconds = self._identify(served, fresh, faults, priority)
        return IdentifiedBatch(vehicle, served, windows, known, fresh, estimates, faults, priority, seconds)

    def keep(self, found: IdentifiedBatch, recording_id: str | None = None) -> Batch:
        """The second half of `process`: track and store, in order of time.

        Windows are identified anew where the tracker, after those before them, knows of other faults than they were
        identified with: what comes out does not depend on how far the halves overlapped, or where a run was stopped.
        """
        while True:
            try:
                batch = self._commit(found, recording_id)
                break
            except ModelChanged:
                found = self.identify(found.vehicle, found.windows, found.priority)
            except FaultsChanged as changed:
                found = self.identify(found.vehicle, found.windows, found.priority, changed.faults)
        batch.seconds |= found.seconds
        if found.known:
            stored = {record.start: record for record in batch.records} | found.known
            batch.records = [stored[w.start] for w in found.windows]
        for listener in self._listeners:
            listener(batch)
        return batch

    def state(self, vehicle: str) -> TrackerState:
        """The vehicle's tracker state as stored; the initial one for a vehicle never seen."""
        with self.store.read() as connection:
            return self._current(connection, [vehicle])[vehicle].state

    def known_faults(self, vehicle: str, served: ServedModel) -> tuple[MeasurementFault, ...]:
        """Of a vehicle's measurements, as far as its tracker is in memory; see `Engine.identify`."""
        with self._lock:
            held = self._vehicles.get(vehicle)
        return () if held is None or held.served is not served else held.known_faults()

    def knows_faults(self, vehicle: str) -> bool:
        """Whether the vehicle's tracker in memory knows of any: they change a little with every batch, so that windows
        that are identified ahead would be identified anew."""
        with self._lock:
            held = self._vehicles.get(vehicle)
        return held is not None and bool(self.known_faults(vehicle, held.served))

    def _identify(
        self,
        served: ServedModel,
        windows: list[Window],
        known: tuple[MeasurementFault, ...],
        priority: Priority,
    ) -> tuple[list[Estimate | None], dict[str, float]]:
        """Estimates, None for dropped windows; and seconds by stage."""
        whole = [w.values for w in windows if w.outcome != "dropped"]
        if not whole:
            return [None] * len(windows), {}
        values = np.stack(whole)  # shape (B, T, C)
        starts = [w.start for w in windows if w.outcome != "dropped"]
        estimates: list[Estimate] = []
        total: dict[str, float] = {}
        while len(estimates) < len(values):
            turn = slice(len(estimates), len(estimates) + self.pace.windows(served, len(values)))
            some, seconds = self._identified(served, values[turn], starts[turn], known, priority)
            estimates += some
            total = {stage: total.get(stage, 0.0) + took for stage, took in seconds.items()}
        found = iter(estimates)
        return [None if w.outcome == "dropped" else next(found) for w in windows], total

    def _identified(
        self,
        served: ServedModel,
        values: FloatArray,
        starts: list[int],
        known: tuple[MeasurementFault, ...],
        priority: Priority,
    ) -> tuple[list[Estimate], dict[str, float]]:
        """Windows (B, T, C) of one vehicle at once; known: faults of its measurements."""
        of_each = [known] * len(values)
        estimates, seconds = self.compute_of(served).run(
            lambda: served.engine.identify(values, starts=starts, known=of_each), priority
        )
        self.pace.note(served, len(values), sum(seconds.values()))
        return estimates, seconds

    def _commit(self, found: IdentifiedBatch, recording_id: str | None) -> Batch:
        prepare(self.store, (window.start for window in found.fresh))
        with self.store.write() as connection:
            folded = self.fold(
                connection,
                found.vehicle,
                found.fresh,
                found.estimates,
                recording_id,
                served=found.served,
                faults=found.faults,
            )
            done = time.perf_counter()
        self._remember(found.vehicle, folded.after)
        folded.batch.seconds["store"] += time.perf_counter() - done
        return folded.batch

    def fold(
        self,
        connection: Connection,
        vehicle: str,
        windows: list[Window],
        estimates: Sequence[Estimate | None],
        recording_id: str | None = None,
        served: ServedModel | None = None,
        faults: tuple[MeasurementFault, ...] | None = None,
    ) -> FoldedWindows:
        """Track and store windows inside a transaction of the caller's; hand what comes back to `settle` after it.

        served, faults: with which they were identified; left out: the caller has looked in this transaction.  Raises
        ModelChanged or FaultsChanged, before anything is stored, where the vehicle is followed with another model by
        now, or its tracker knows of other faults.

        The vehicle is held until the transaction ends: whoever folds several uses `fold_all`.  The caller has called
        `partitions.prepare` before.
        """
        at = self.hold_all(connection, [vehicle])[vehicle]
        if served is not None and served.model_id != at.served.model_id:
            raise ModelChanged(vehicle)
        if faults is not None and any(estimate is not None for estimate in estimates):
            now = at.known_faults()
            if now != faults:
                raise FaultsChanged(now)
        # another process may have stored some of them while this one was identifying
        raced = known_windows(connection, vehicle, at.served.model_id, [w.start for w in windows])
        left = [(w, e) for w, e in zip(windows, estimates, strict=True) if w.start not in raced]
        asked = WindowsToFold(vehicle, [w for w, _ in left], [e for _, e in left], at)
        folded = self.fold_all(connection, [asked], recording_id)[0]
        if raced:
            stored = {record.start: record for record in folded.batch.records} | raced
            folded.batch.records = [stored[w.start] for w in windows]
        return folded

    def fold_all(
        self, connection: Connection, asked: Sequence[WindowsToFold], recording_id: str | None = None
    ) -> list[FoldedWindows]:
        """As `fold`, of several vehicles that are held (`hold_all`), each once, with the statements of one."""
        if not asked:
            return []
        now, started = self._clock(), time.perf_counter()
        followed: list[tuple[WindowsToFold, FollowedWindows, HeldVehicle, TrackerChange | None]] = []
        with closing(self._follow(asked, now)) as each:
            for one, passed in zip(asked, each, strict=True):
                after = replace(one.at, state=passed.followed.state, last_window_ns=passed.followed.last)
                change = None
                if passed.records:
                    after = after.with_stored(r.start for r in passed.records)
                    change = TrackerChange(one.vehicle, after, passed.records, passed.ran).made_ready(self._shown)
                followed.append((one, passed, after, change))
        tracked = time.perf_counter()
        changes = [change for *_, change in followed if change is not None]
        on_alarms = self._on_alarms if self._shown else None
        views = keep_changes(connection, changes, now, on_alarms, recording_id, self.aging()) if changes else {}
        share = {"track": (tracked - started) / len(asked), "store": (time.perf_counter() - tracked) / len(asked)}
        return [
            self._folded(one, passed.records, after, dict(share), views.get(one.vehicle))
            for one, passed, after, _ in followed
        ]

    def _folded(
        self,
        one: WindowsToFold,
        records: list[WindowRecord],
        after: HeldVehicle,
        seconds: dict[str, float],
        view: VehicleView | None,
    ) -> FoldedWindows:
        late = sum(record.solved is not None and not record.tracked for record in records)
        batch = Batch(one.vehicle, records, list(one.windows), late, after.state, one.at.served, seconds, view)
        return FoldedWindows(batch, after)

    def settle(self, folded: FoldedWindows) -> None:
        """The transaction of `fold` is committed: remember the tracker and tell every listener."""
        self._remember(folded.batch.vehicle, folded.after)
        self.publish(folded.batch)

    def hold_all(self, connection: Connection, vehicles: Collection[str]) -> dict[str, HeldVehicle]:
        """Keep others from folding windows of some vehicles until the transaction ends; how their trackers stand."""
        fleet.take_vehicles(connection, vehicles, self._clock(), listed=self._shown)
        return self._current(connection, vehicles)

    def _current(self, connection: Connection, vehicles: Collection[str]) -> dict[str, HeldVehicle]:
        """The vehicles' trackers: from memory when that is still what is stored, else read anew."""
        with self._lock:
            found = {vehicle: self._vehicles[vehicle] for vehicle in vehicles if vehicle in self._vehicles}
        models = self.engines.of_all(connection, vehicles)
        revisions = fleet.tracker_revisions(connection, vehicles)
        for vehicle, served in models.items():
            held = found.get(vehicle)
            revision = revisions.get((vehicle, served.model_id))
            if held is None or held.revision != revision or held.served is not served:
                found[vehicle] = self._read(connection, vehicle, served)
        return found

    def _read(self, connection: Connection, vehicle: str, served: ServedModel) -> HeldVehicle:
        row = fleet.load_tracker(connection, vehicle, served.model_id)
        if row is None:
            # a back-fill must not depend on which vehicle is done first
            new = self._newcomer(connection, served) if self._shown else served.engine.tracker.initial_state()
            return HeldVehicle(served, 0, -1, new)
        return HeldVehicle(served, row.revision, row.last_window_ns, served.engine.load_state(row.state))

    def _newcomer(self, connection: Connection, served: ServedModel) -> TrackerState:
        """State of a vehicle never seen: what weather does to springs, others of its fleet have learned.

        Reading what they have learned takes as long as folding ten windows, and changes over days: it is kept until
        there are a tenth more of them, for an hour at the most.
        """
        if served.model_id != self.model_id:  # a model of its own: no other vehicle has learned under it
            return served.engine.tracker.initial_state()
        count, now = fleet.count_trackers(connection, self.model_id), self._clock()
        held = self._last_newcomer
        if held is None or count >= FRESH_GROWTH * held.vehicles or not 0 <= now - held.at < FRESH_NS:
            rows = fleet.latest_trackers(connection, self.model_id, LEARNED_FROM)
            state = self.engine.tracker.initial_state_from([self.engine.load_state(row.state) for row in rows])
            self._last_newcomer = held = Newcomer(count, now, state)
        return held.state

    def relearn(self, vehicle: str, names: Sequence[str] | None, connection: Connection) -> Batch:
        """Forget baselines (all, or those of `names`) inside a transaction of the caller's, e.g. after a repair.

        Raises TrackerStateError for a parameter that the system does not have.  Hand the batch to `tell` once the
        transaction is committed.
        """
        now = self._clock()
        fleet.ensure_vehicle(connection, vehicle, now)
        fleet.hold_vehicle(connection, vehicle)
        at = self._current(connection, [vehicle])[vehicle]
        after = replace(at, state=at.served.engine.tracker.relearn(at.state, names), revision=at.revision + 1)
        on_alarms = self._on_alarms if self._shown else None
        views = keep_changes(connection, [TrackerChange(vehicle, after)], now, on_alarms)
        return Batch(vehicle, [], [], 0, after.state, at.served, view=views.get(vehicle))

    def publish(self, batch: Batch) -> None:
        """Let every listener know of a change that came without windows."""
        for listener in self._listeners:
            listener(batch)

    def refresh_statuses(self) -> int:
        """Make the rows of the fleet's list that are missing, as in a store of an earlier version; how many."""
        with self.store.read() as connection:
            missing = status.outdated(connection, self.model_id)
        for vehicle in missing:
            with self.store.write() as connection:
                fleet.hold_vehicle(connection, vehicle)
                at = self._current(connection, [vehicle])[vehicle]
                keep_statuses(connection, [TrackerChange(vehicle, at)], self._clock())
        return len(missing)

    def show(self, connection: Connection, vehicle: str) -> None:
        """Make the vehicle's line in the fleet's list anew from what is stored; hold the vehicle before."""
        now, at = self._clock(), self._current(connection, [vehicle])[vehicle]
        fleet.ensure_vehicle(connection, vehicle, now)
        last = latest_window(connection, vehicle, at.served.model_id)
        status.forget_counts(connection, vehicle)
        counts = status.count_windows(connection, vehicle, at.served.model_id)
        view = vehicle_view(at.served.engine, vehicle, at.state, last)
        status.save_statuses(connection, [new_status(at, view, counts)], now)

    def switched(self, connection: Connection, vehicle: str) -> Batch:
        """After a vehicle was given another model, inside the transaction that did it: its line in the fleet's list
        is that of the model.  Hand the batch to `tell` once the transaction is committed."""
        self.show(connection, vehicle)
        at = self._current(connection, [vehicle])[vehicle]
        return Batch(vehicle, [], [], 0, at.state, at.served)

    def _remember(self, vehicle: str, at: HeldVehicle) -> None:
        with self._lock:
            self._vehicles[vehicle] = at
