"""What folding has changed into the store: of many vehicles with the statements of one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from sqlalchemy import Connection

from sprung.service.monitoring.processed import HeldVehicle
from sprung.service.monitoring.views import VehicleView, vehicle_view
from sprung.service.store import fleet, history, status
from sprung.service.store.circumstances import WindowCircumstances, add_circumstances
from sprung.service.store.standstill import UNINFORMATIVE
from sprung.service.store.status import NewStatus
from sprung.service.store.windows import VehicleWindows, WindowRecord, add_windows

OnAlarms = Callable[[Connection, str, Sequence[fleet.AlarmChange]], None]


@dataclass(frozen=True)
class TrackerChange:
    """A vehicle whose tracker is another one now."""

    vehicle: str
    after: HeldVehicle
    records: Sequence[WindowRecord] = ()  # that are not stored yet
    ran: Sequence[WindowCircumstances] = ()  # how the vehicle ran in them

    @cached_property
    def row(self) -> fleet.TrackerRow:
        """The tracker as it is stored."""
        return fleet.TrackerRow(self.after.last_window_ns, self.after.revision, self.after.state.to_dict())

    @cached_property
    def view(self) -> VehicleView:
        """How the vehicle is seen after its windows."""
        informative = (r for r in reversed(self.records) if r.solved is not None and r.outcome != UNINFORMATIVE)
        return vehicle_view(self.after.served.engine, self.vehicle, self.after.state, next(informative, None))

    def made_ready(self, shown: bool) -> TrackerChange:
        """Itself, with what `keep_changes` takes made before the store waits for it; shown: with the view."""
        _ = (self.row, self.view) if shown else self.row
        return self


def keep_changes(
    connection: Connection,
    changes: Sequence[TrackerChange],
    now: int,
    on_alarms: OnAlarms | None,
    recording_id: str | None = None,
    aged: int | None = None,
) -> dict[str, VehicleView]:
    """Windows, roll-ups, trackers, alarms and lines of the fleet's list, each vehicle once; all of them are held.

    now: the host's clock, ns; aged: that by which the windows age, where it is another.

    Returns how the vehicles are seen now.  on_alarms: None while nobody is to see anything of it
    (`service.store.staging`): only the history is kept then, and nothing is returned.
    """
    aged = now if aged is None else aged
    stored = [VehicleWindows(one.vehicle, one.after.served.model_id, one.records) for one in changes if one.records]
    if stored:
        add_windows(connection, stored, aged, recording_id)
        history.add_to_rollups(connection, stored, aged)
    if on_alarms is not None:
        add_circumstances(connection, {one.vehicle: one.ran for one in changes}, aged)
    fleet.save_trackers(connection, {(one.vehicle, one.after.served.model_id): one.row for one in changes}, now)
    for one in changes:
        found = fleet.save_alarms(connection, one.vehicle, one.after.served.model_id, one.after.state.alarms)
        if found and on_alarms is not None:
            on_alarms(connection, one.vehicle, found)
    return {} if on_alarms is None else keep_statuses(connection, changes, now)


def keep_statuses(connection: Connection, changes: Sequence[TrackerChange], now: int) -> dict[str, VehicleView]:
    """Lines of the fleet's list, with the windows that are new; how the vehicles are seen with it."""
    statuses, views = [], {}
    for one in changes:
        unfitting = [
            record
            for record in one.records
            if record.outcome != UNINFORMATIVE and record.solved is not None and not record.solved.adequate
        ]
        counts = Counter(record.outcome for record in one.records)
        counts["unfitting"] = len(unfitting)
        views[one.vehicle] = one.view
        statuses.append(new_status(one.after, one.view, counts))
        reasons = [(record.outcome, record.reason, record.start) for record in one.records if record.reason]
        reasons += [("unfitting", "does not fit the model", record.start) for record in unfitting]
        status.add_reasons(connection, one.vehicle, one.after.served.model_id, reasons)
    status.save_statuses(connection, statuses, now)
    return views


def new_status(at: HeldVehicle, view: VehicleView, counts: Counter[str]) -> NewStatus:
    """A vehicle's line."""
    found = view.status(at.served.engine.system.elements)
    return NewStatus(view.vehicle, at.served.model_id, at.revision, found, counts)
