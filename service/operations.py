"""What people do to vehicles and alarms: each deed in one transaction, with its line in the audit log.

`noted` writes more down in that transaction: the answer that a repeated request gets.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from typing import TypeVar

from sqlalchemy import Connection

from sprung.service.errors import NotFound
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.settings import Settings
from sprung.service.store import audit, fleet, marks, status, vehicle_models
from sprung.service.store.archive import Archive
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.marks import MarkRow
from sprung.service.store.vehicle_models import SERVICE_FILE
from sprung.service.store.windows import latest_window
from sprung.service.times import now_ns

MOST_ALARMS = 10_000
T = TypeVar("T")
Noted = Callable[[Connection, T], None]  # called inside the transaction of a deed with what came of it


def _unnoted(connection: Connection, found: object) -> None:
    """Nobody else writes a deed down."""


class Operations:
    """Safe to share between threads."""

    def __init__(
        self, settings: Settings, pipeline: Pipeline, forget: Callable[[str], None], archive: Archive | None = None
    ) -> None:
        """forget: takes a vehicle out of what metrics and pages show."""
        self._settings = settings
        self._pipeline = pipeline
        self._store = pipeline.store
        self._forget = forget
        self._archive = archive

    def acknowledge(self, actor: str, vehicle: str, alarm: int | None = None, noted: Noted[int] = _unnoted) -> int:
        """Write down that somebody has seen a vehicle's alarm, or all that are active; how many.  Raises NotFound."""
        now = now_ns()
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            wanted = WantedAlarms(vehicle, active=alarm is None, acknowledged=False if alarm is None else None)
            found = [row for row in fleet.list_alarms(connection, wanted, MOST_ALARMS) if alarm in (None, row.id)]
            if alarm is not None and not found:
                raise NotFound(f"vehicle {vehicle} has no alarm {alarm}")
            for row in found:
                assert row.id is not None
                fleet.acknowledge(connection, row.id, actor, now)
            status.refresh_urgency(connection, vehicle)
            detail = {"alarms": [row.id for row in found][:100]}
            audit.record(connection, actor, "acknowledge", vehicle, detail, now)
            noted(connection, len(found))
        return len(found)

    def note(self, actor: str, vehicle: str, text: str, time: int | None, noted: Noted[MarkRow] = _unnoted) -> MarkRow:
        """Write a note on the time line.  Raises NotFound."""
        now = now_ns()
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            row = MarkRow(0, vehicle, "note", now if time is None else time, text, None, actor, now)
            kept = marks.add_mark(connection, row)
            audit.record(connection, actor, "note", vehicle, {"mark": kept.id}, now)
            noted(connection, kept)
        return kept

    def maintenance(
        self,
        actor: str,
        vehicle: str,
        text: str,
        time: int | None,
        parameters: Sequence[str] | None,
        noted: Noted[MarkRow] = _unnoted,
    ) -> MarkRow:
        """Mark a maintenance and forget the baselines of `parameters` (None: of all; empty: of none).

        Their alarms close, and those of earlier models where all are learned anew.  Raises NotFound for an unknown
        vehicle, TrackerStateError for an unknown parameter.
        """
        now = now_ns()
        batch = None
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            if parameters is None:
                model = self._pipeline.engines.of(connection, vehicle).model_id
                fleet.close_alarms_of_other_models(connection, vehicle, model, now)
            if parameters is None or parameters:
                batch = self._pipeline.relearn(vehicle, parameters, connection)
            learned = [] if parameters is None else list(parameters) or None
            row = MarkRow(0, vehicle, "maintenance", now if time is None else time, text, learned, actor, now)
            kept = marks.add_mark(connection, row)
            audit.record(connection, actor, "maintenance", vehicle, {"mark": kept.id, "parameters": learned}, now)
            noted(connection, kept)
        if batch is not None:
            self._pipeline.publish(batch)
        return kept

    def give_model(self, actor: str, vehicle: str, text: str, report: str | None, noted: Noted[int] = _unnoted) -> int:
        """Keep a system file as the vehicle's next version and follow it with that from now on; the version.

        One that the vehicle has had before is used again as the version that it was.
        Baselines are learned anew under it; what was estimated before stays under the version before.  Alarms that
        windows do not fit close, since they were said of that one.  Raises NotFound, UserError for a file that is
        not of the same measurements or that windows cannot be identified with.
        """
        engines, now = self._pipeline.engines, now_ns()
        engine = engines.tried(text, f"the system file for vehicle {vehicle}")  # takes seconds: before the store waits
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            fleet.hold_vehicle(connection, vehicle)
            model = fleet.ensure_model(connection, engine.digest, engine.system.name, engine.description(), now)
            version = vehicle_models.version_of(connection, vehicle, text)
            if version is not None and version == vehicle_models.current_version(connection, vehicle):
                noted(connection, version)
                return version
            if version is None:
                version = vehicle_models.add_version(connection, vehicle, model, text, report, actor, now)
            engines.remember(vehicle, ServedModel(version, engine, model))
            batch = self._switch(connection, actor, vehicle, version, report, now)
            noted(connection, version)
        self._pipeline.publish(batch)
        return version

    def use_model(self, actor: str, vehicle: str, version: int, noted: Noted[int] = _unnoted) -> None:
        """Follow a vehicle with an earlier version again, or with the service's own file (0).

        Raises NotFound where there is no such version, UserError where it does not belong to this service any more.
        """
        now = now_ns()
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            fleet.hold_vehicle(connection, vehicle)
            if version != SERVICE_FILE and vehicle_models.get_version(connection, vehicle, version) is None:
                raise NotFound(f"vehicle {vehicle} has no model {version}")
            if version == vehicle_models.current_version(connection, vehicle):
                noted(connection, version)
                return
            self._pipeline.engines.version(connection, vehicle, version)
            batch = self._switch(connection, actor, vehicle, version, None, now)
            noted(connection, version)
        self._pipeline.publish(batch)

    def _switch(
        self, connection: Connection, actor: str, vehicle: str, version: int, report: str | None, now: int
    ) -> Batch:
        before = vehicle_models.current_version(connection, vehicle)
        vehicle_models.put_to_use(connection, vehicle, version, actor, now)
        model = self._pipeline.engines.of(connection, vehicle).model_id
        fleet.close_misfits_of_other_models(connection, vehicle, model, now)
        name = "the service's system file" if version == SERVICE_FILE else f"model {version}"
        text = f"followed with {name} from here on" + (f", as found in report {report}" if report else "")
        old = vehicle_models.get_version(connection, vehicle, before)
        newest = latest_window(connection, vehicle, self._pipeline.model_id if old is None else old.model_id)
        at = now if newest is None else newest.start  # on the data's time line, where recordings are older than today
        marks.add_mark(connection, MarkRow(0, vehicle, "model", at, text, None, actor, now))
        detail = {"version": version, "before": before, "report": report}
        audit.record(connection, actor, "model", vehicle, detail, now)
        return self._pipeline.switched(connection, vehicle)

    def rename(self, actor: str, vehicle: str, label: str | None) -> None:
        """Change what people call the vehicle; recordings keep its id.  Raises NotFound."""
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            marks.rename(connection, vehicle, label)
            audit.record(connection, actor, "rename", vehicle, {"label": label}, now_ns())

    def retire(self, actor: str, vehicle: str, retired: bool) -> None:
        """Take a vehicle out of the fleet's list and the metrics, or back into them.  Raises NotFound."""
        now = now_ns()
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            marks.retire(connection, vehicle, now if retired else None)
            audit.record(connection, actor, "retire" if retired else "return", vehicle, None, now)
        if retired:
            self._forget(vehicle)

    def remove(self, actor: str, vehicle: str) -> None:
        """Delete a vehicle with all its data: windows, alarms, reports, uploaded files.  Raises NotFound.

        The store comes after the archive: where the process is killed in between, the vehicle is there to be deleted
        again.  Files that the store knows nothing of any more are deleted at the next start, too.
        """
        with self._store.read() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
        self._remove_archived(vehicle)
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            removed = marks.remove(connection, vehicle)
            audit.record(connection, actor, "delete", vehicle, None, now_ns())
        self._forget(vehicle)
        self._remove_archived(vehicle)  # what was archived meanwhile
        for name in removed.upload_files:
            (self._settings.uploads / name).unlink(missing_ok=True)
        for report in removed.reports:
            shutil.rmtree(self._settings.reports / report, ignore_errors=True)

    def _remove_archived(self, vehicle: str) -> None:
        if self._archive is not None:
            self._archive.remove(vehicle)

    @staticmethod
    def _known(found: bool, vehicle: str) -> None:
        if not found:
            raise NotFound(f"nothing is known of vehicle {vehicle[:128]!r}")
