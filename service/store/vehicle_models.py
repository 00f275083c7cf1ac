"""System files of single vehicles: versions as they were made, and which one was in use since when.

Version 0 is the service's own system file and has no row.  Nothing here is ever changed: a version that is put back is
one more line of use.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select

from sprung.service.store.schema import vehicle_model_uses, vehicle_models, windows

SERVICE_FILE = 0  # the version that every vehicle begins with


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """One version, without its text."""

    version: int
    model_id: int  # row of `models` under which its windows are stored
    report_id: str | None  # the diagnosis that it comes from
    author: str
    created_ns: int


@dataclass(frozen=True, slots=True)
class ModelUse:
    """From when on a version was in use, and who said so."""

    version: int
    since_ns: int
    author: str


@dataclass(frozen=True, slots=True)
class Fitting:
    """The windows that a vehicle has under one model."""

    windows: int  # that were identified
    adequate: int  # of these, those that fit
    first_ns: int | None
    last_ns: int | None


def current_version(connection: Connection, vehicle: str) -> int:
    """The version in use."""
    table = vehicle_model_uses
    query = select(table.c.version).where(table.c.vehicle_id == vehicle).order_by(table.c.id.desc()).limit(1)
    found = connection.execute(query).scalar()
    return SERVICE_FILE if found is None else int(found)


def with_own_models(connection: Connection, vehicles: Iterable[str]) -> set[str]:
    """Which of the vehicles were ever given a model of their own."""
    table = vehicle_model_uses
    query = select(table.c.vehicle_id).where(table.c.vehicle_id.in_(list(vehicles))).distinct()
    return set(connection.execute(query).scalars())


def list_versions(connection: Connection, vehicle: str) -> list[ModelVersion]:
    """Versions of a vehicle, oldest first; the service's file is not among them."""
    table = vehicle_models
    columns = (table.c[name] for name in ModelVersion.__slots__)
    query = select(*columns).where(table.c.vehicle_id == vehicle).order_by(table.c.version)
    return [ModelVersion(*row) for row in connection.execute(query)]


def get_version(connection: Connection, vehicle: str, version: int) -> ModelVersion | None:
    """One version; None where there is none, as of the service's file."""
    return next((row for row in list_versions(connection, vehicle) if row.version == version), None)


def text_of(connection: Connection, vehicle: str, version: int) -> str | None:
    """The system file of a version."""
    table = vehicle_models
    query = select(table.c.text).where(table.c.vehicle_id == vehicle, table.c.version == version)
    return connection.execute(query).scalar_one_or_none()


def version_of(connection: Connection, vehicle: str, text: str) -> int | None:
    """The newest version of this very system file; None: the vehicle never had it."""
    table = vehicle_models
    known = select(func.max(table.c.version)).where(table.c.vehicle_id == vehicle, table.c.text == text)
    return connection.execute(known).scalar()


def add_version(
    connection: Connection, vehicle: str, model_id: int, text: str, report_id: str | None, author: str, now: int
) -> int:
    """Keep a system file as the vehicle's next version; its number.  Hold the vehicle before."""
    table = vehicle_models
    last = connection.execute(select(func.max(table.c.version)).where(table.c.vehicle_id == vehicle)).scalar()
    version = (last or SERVICE_FILE) + 1
    values = {"vehicle_id": vehicle, "version": version, "model_id": model_id, "text": text}
    values |= {"report_id": report_id, "author": author[:160], "created_ns": now}
    connection.execute(insert(table).values(**values))
    return int(version)


def put_to_use(connection: Connection, vehicle: str, version: int, author: str, now: int) -> None:
    """From now on the vehicle's windows are identified with this version."""
    values = {"vehicle_id": vehicle, "version": version, "author": author[:160], "since_ns": now}
    connection.execute(insert(vehicle_model_uses).values(**values))


def list_uses(connection: Connection, vehicle: str) -> list[ModelUse]:
    """Which version was in use since when, oldest first; before the first line it was the service's file."""
    table = vehicle_model_uses
    columns = (table.c[name] for name in ModelUse.__slots__)
    query = select(*columns).where(table.c.vehicle_id == vehicle).order_by(table.c.id)
    return [ModelUse(*row) for row in connection.execute(query)]


def own_model_ids(connection: Connection) -> list[int]:
    """Rows of `models` that belong to vehicles' own files, in use or not."""
    return list(connection.execute(select(vehicle_models.c.model_id).distinct()).scalars())


def fitting(connection: Connection, vehicle: str, model_id: int) -> Fitting:
    """How the vehicle's windows fit under a model."""
    table = windows
    fits = func.count().filter(table.c.adequate.is_(True))
    query = select(func.count(), fits, func.min(table.c.start_ns), func.max(table.c.start_ns)).where(
        table.c.vehicle_id == vehicle,
        table.c.model_id == model_id,
        table.c.nrmse.is_not(None),
        table.c.outcome != "uninformative",
    )
    return Fitting(*connection.execute(query).one())
