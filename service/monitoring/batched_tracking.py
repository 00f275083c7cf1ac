"""Windows of several vehicles, identified already, tracked and stored in one transaction."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import Connection

from sprung.model.signals import Estimate, Window
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import HeldVehicle, WindowsToFold
from sprung.service.store.partitions import prepare
from sprung.service.store.windows import WindowRecord, known_windows, newest_start


@dataclass(frozen=True, slots=True)
class FoundWindow:
    """A window with its results."""

    vehicle: str
    window: Window
    estimate: Estimate
    served: ServedModel  # with which it was identified


def track_together(pipeline: Pipeline, found: Sequence[FoundWindow]) -> list[WindowRecord]:
    """Records of the windows, in their order; they are committed when this returns.

    One that is stored already is read back.  One whose vehicle is followed with another model by now is identified
    again.
    """
    by_vehicle: dict[str, list[FoundWindow]] = {}
    for one in found:
        by_vehicle.setdefault(one.vehicle, []).append(one)
    prepare(pipeline.store, (one.window.start for one in found))
    records: dict[tuple[str, int], WindowRecord] = {}
    with pipeline.store.write() as connection:
        held = pipeline.hold_all(connection, by_vehicle)
        asked: list[WindowsToFold] = []
        for vehicle, theirs in by_vehicle.items():
            at = held[vehicle]
            sent = {one.window.start: one for one in theirs if one.served.model_id == at.served.model_id}
            at, stored = _stored(connection, vehicle, at, sent)
            records |= {(vehicle, start): record for start, record in stored.items()}
            fresh = [sent[start] for start in sorted(sent) if start not in stored]
            if fresh:
                asked.append(WindowsToFold(vehicle, [one.window for one in fresh], [one.estimate for one in fresh], at))
        folded = pipeline.fold_all(connection, asked)
    for done in folded:
        records |= {(done.batch.vehicle, record.start): record for record in done.batch.records}
        pipeline.settle(done)
    return [records.get((one.vehicle, one.window.start)) or _again(pipeline, one) for one in found]


def _stored(
    connection: Connection, vehicle: str, at: HeldVehicle, starts: Collection[int]
) -> tuple[HeldVehicle, dict[int, WindowRecord]]:
    """Which of the vehicle's windows are stored, by start; asked only where one is no newer than the newest."""
    model, newest = at.served.model_id, at.newest_ns
    if newest is None:
        newest = newest_start(connection, vehicle, model, at.last_window_ns)
        at = replace(at, newest_ns=newest)
    older = [start for start in starts if start <= max(at.last_window_ns, newest)]
    return at, known_windows(connection, vehicle, model, older) if older else {}


def _again(pipeline: Pipeline, one: FoundWindow) -> WindowRecord:
    return pipeline.process(one.vehicle, [one.window], priority=Priority.REQUEST).records[0]
