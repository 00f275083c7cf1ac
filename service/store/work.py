"""Recordings, jobs and reports."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, func, insert, select, update

from sprung.service.store.schema import jobs, recordings, reports, windows

ALARM_SOURCE = "alarm"  # of recordings: the signals that were kept when an alarm was raised
UNFINISHED = ("queued", "running")
DIGITS = 32  # of the SHA-256 of an upload in its file's name


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """A file or stream that was read."""

    id: str
    vehicle_id: str | None
    name: str
    source: str
    file: str | None
    size_bytes: int | None
    tally: dict[str, Any] | None
    created_ns: int
    finished_ns: int | None
    began_ns: int | None = None  # as its sender has said, for times that count from 0
    kept_since_ns: int | None = None  # by the clock of retention, which ignores leaps of the host's


@dataclass(frozen=True, slots=True)
class JobRow:
    """Work that goes on after its request was answered."""

    id: str
    kind: str
    state: str
    recording_id: str | None
    vehicle_id: str | None
    progress: float
    result: dict[str, Any] | None
    error: str | None
    created_ns: int
    updated_ns: int
    attempts: int = 0  # starts that did not end in good order


@dataclass(frozen=True, slots=True)
class ReportRow:
    """A mismatch report."""

    id: str
    vehicle_id: str | None
    recording_id: str | None
    verdict: str
    report: dict[str, Any]
    created_ns: int


def new_id() -> str:
    """A random identifier that tells nothing and cannot be guessed."""
    return str(uuid.uuid4())


def add_recording(connection: Connection, row: RecordingRow) -> None:
    """Store a recording's row."""
    connection.execute(insert(recordings).values(**_as_dict(row)))


def finish_recording(
    connection: Connection, recording_id: str, vehicle: str | None, tally: dict[str, Any], now: int
) -> None:
    """Write down what reading the recording came to."""
    connection.execute(
        update(recordings)
        .where(recordings.c.id == recording_id)
        .values(vehicle_id=vehicle, tally=tally, finished_ns=now)
    )


def get_recording(connection: Connection, recording_id: str) -> RecordingRow | None:
    """A recording by id."""
    row = _one(connection, recordings, recording_id)
    return None if row is None else RecordingRow(*row)


def recording_names(connection: Connection, ids: Collection[str]) -> dict[str, str]:
    """What users called recordings, by id."""
    query = select(recordings.c.id, recordings.c.name).where(recordings.c.id.in_(ids))
    return {row.id: row.name for row in connection.execute(query)}


def upload_name(digest: str, recording_id: str, extension: str) -> str:
    """The name of an upload's file: what is in it, whose row it is, and an extension; nothing that a client chose."""
    return f"{digest[:DIGITS]}-{recording_id[:8]}{extension}"


def same_upload(connection: Connection, row: RecordingRow, vehicle: str | None) -> RecordingRow | None:
    """An upload with the same content, name and stated start, sent for the same vehicle before, whose file is still
    kept."""
    if row.file is None or len(row.file) <= DIGITS or row.source != "upload":
        return None
    query = (
        select(recordings)
        .join(jobs, jobs.c.recording_id == recordings.c.id)
        .where(recordings.c.file.startswith(f"{row.file[:DIGITS]}-", autoescape=True))
        .where(recordings.c.name == row.name, recordings.c.source == "upload")
        .where(recordings.c.began_ns.is_not_distinct_from(row.began_ns))
        .where(jobs.c.vehicle_id.is_not_distinct_from(vehicle))
        .limit(1)
    )
    found = connection.execute(query).first()
    return None if found is None else RecordingRow(*found)


def waiting_job(connection: Connection, kind: str, recording_id: str, vehicle: str | None) -> JobRow | None:
    """A job that does the same and has not ended."""
    query = select(jobs).where(
        jobs.c.kind == kind,
        jobs.c.recording_id == recording_id,
        jobs.c.vehicle_id.is_not_distinct_from(vehicle),
        jobs.c.state.in_(UNFINISHED),
    )
    found = connection.execute(query.limit(1)).first()
    return None if found is None else JobRow(*found)


def add_job(connection: Connection, row: JobRow) -> None:
    """Store a job's row."""
    connection.execute(insert(jobs).values(**_as_dict(row)))


def update_job(connection: Connection, job_id: str, now: int, **values: Any) -> None:
    """Change columns of a job."""
    connection.execute(update(jobs).where(jobs.c.id == job_id).values(updated_ns=now, **values))


def get_job(connection: Connection, job_id: str) -> JobRow | None:
    """A job by id."""
    row = _one(connection, jobs, job_id)
    return None if row is None else JobRow(*row)


def unfinished_jobs(connection: Connection) -> Sequence[JobRow]:
    """Jobs that a previous process accepted and did not finish, oldest first."""
    query = select(jobs).where(jobs.c.state.in_(UNFINISHED)).order_by(jobs.c.created_ns)
    return [JobRow(*row) for row in connection.execute(query)]


def alarm_recordings(connection: Connection, vehicle: str) -> list[RecordingRow]:
    """Signals of a vehicle's alarms whose files are kept, newest first."""
    query = select(recordings).where(
        recordings.c.vehicle_id == vehicle, recordings.c.source == ALARM_SOURCE, recordings.c.file.is_not(None)
    )
    return [RecordingRow(*row) for row in connection.execute(query.order_by(recordings.c.created_ns.desc()))]


def recording_at(connection: Connection, vehicle: str, time: int) -> RecordingRow | None:
    """The recording that the newest window of a vehicle which began before a time came from, if it came from one."""
    table = windows
    query = select(table.c.recording_id).where(table.c.vehicle_id == vehicle, table.c.start_ns <= time)
    found = connection.execute(query.order_by(table.c.start_ns.desc()).limit(1)).scalar()
    return None if found is None else get_recording(connection, found)


def recordings_between(
    connection: Connection, vehicle: str, model_id: int, first: int, last: int
) -> list[RecordingRow]:
    """The recordings that windows of a vehicle with first <= start <= last came from."""
    table = windows
    of_vehicle = select(table.c.recording_id).where(table.c.vehicle_id == vehicle, table.c.model_id == model_id)
    query = select(recordings).where(recordings.c.id.in_(of_vehicle.where(table.c.start_ns.between(first, last))))
    return [RecordingRow(*row) for row in connection.execute(query)]


def stored_files(connection: Connection) -> set[str]:
    """Names inside the upload folder that recordings refer to."""
    return set(connection.execute(select(recordings.c.file).where(recordings.c.file.is_not(None))).scalars())


def kept_reports(connection: Connection) -> set[str]:
    """Ids of the reports, which are names inside the report folder."""
    return set(connection.execute(select(reports.c.id)).scalars())


def stored_bytes(connection: Connection) -> int:
    """Bytes of the uploads and excerpts that are kept."""
    query = select(func.coalesce(func.sum(recordings.c.size_bytes), 0)).where(
        recordings.c.file.is_not(None), recordings.c.source.in_(("upload", "excerpt", ALARM_SOURCE))
    )
    return int(connection.execute(query).scalar_one())


def add_report(connection: Connection, row: ReportRow) -> None:
    """Store a report."""
    connection.execute(insert(reports).values(**_as_dict(row)))


def get_report(connection: Connection, report_id: str) -> ReportRow | None:
    """A report by id."""
    row = _one(connection, reports, report_id)
    return None if row is None else ReportRow(*row)


def _one(connection: Connection, table: Table, key: str) -> Any:
    return connection.execute(select(table).where(table.c.id == key)).first()


def _as_dict(row: Any) -> dict[str, Any]:
    return {name: getattr(row, name) for name in row.__slots__}
