"""What people do to vehicles and alarms: each deed in one transaction, with its line in the audit log."""

from __future__ import annotations

import shutil
from collections.abc import Sequence

from sprung.service.board import Board
from sprung.service.errors import NotFound
from sprung.service.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import audit, fleet, marks, status
from sprung.service.store.archive import Archive
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.marks import MarkRow
from sprung.service.times import now_ns

MOST_ALARMS = 10_000


class Operations:
    """Safe to share between threads."""

    def __init__(self, settings: Settings, pipeline: Pipeline, board: Board, archive: Archive | None = None) -> None:
        self._settings = settings
        self._pipeline = pipeline
        self._store = pipeline.store
        self._board = board
        self._archive = archive

    def acknowledge(self, actor: str, vehicle: str, alarm: int | None = None) -> int:
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
        return len(found)

    def note(self, actor: str, vehicle: str, text: str, time: int | None) -> MarkRow:
        """Write a note on the time line.  Raises NotFound."""
        now = now_ns()
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            row = MarkRow(0, vehicle, "note", now if time is None else time, text, None, actor, now)
            kept = marks.add_mark(connection, row)
            audit.record(connection, actor, "note", vehicle, {"mark": kept.id}, now)
        return kept

    def maintenance(
        self, actor: str, vehicle: str, text: str, time: int | None, parameters: Sequence[str] | None
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
                fleet.close_alarms_of_other_models(connection, vehicle, self._pipeline.model_id, now)
            if parameters is None or parameters:
                batch = self._pipeline.relearn(vehicle, parameters, connection)
            learned = [] if parameters is None else list(parameters) or None
            row = MarkRow(0, vehicle, "maintenance", now if time is None else time, text, learned, actor, now)
            kept = marks.add_mark(connection, row)
            audit.record(connection, actor, "maintenance", vehicle, {"mark": kept.id, "parameters": learned}, now)
        if batch is not None:
            self._pipeline.tell(batch)
        return kept

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
            self._board.forget(vehicle)

    def remove(self, actor: str, vehicle: str) -> None:
        """Delete a vehicle with all its data: windows, alarms, reports, uploaded files.  Raises NotFound."""
        with self._store.write() as connection:
            self._known(fleet.vehicle_exists(connection, vehicle), vehicle)
            removed = marks.remove(connection, vehicle)
            audit.record(connection, actor, "delete", vehicle, None, now_ns())
        self._board.forget(vehicle)
        if self._archive is not None:
            self._archive.remove(vehicle)
        for name in removed.upload_files:
            (self._settings.uploads / name).unlink(missing_ok=True)
        for report in removed.reports:
            shutil.rmtree(self._settings.reports / report, ignore_errors=True)

    @staticmethod
    def _known(found: bool, vehicle: str) -> None:
        if not found:
            raise NotFound(f"nothing is known of vehicle {vehicle[:128]!r}")
