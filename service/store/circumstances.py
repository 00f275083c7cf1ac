"""How vehicles ran: load, temperature, speed and pressures as means of minutes and hours, for plots below histories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, select, tuple_

from sprung.service.store.engine import upsert
from sprung.service.store.history import LEVELS, NICE
from sprung.service.store.schema import circumstances
from sprung.service.store.standstill import STANDING
from sprung.service.store.windows import IN_LIMIT
from sprung.service.times import NANOSECONDS

KEY = ("vehicle_id", "resolution_s", "bucket_ns")
Means = dict[str, list[float]]  # name -> number of windows, mean


@dataclass(frozen=True, slots=True)
class WindowCircumstances:
    """What is known of one window beside its estimate."""

    start: int  # ns since epoch
    values: Mapping[str, float]  # `car.load` in kg, `temperature` in degC, `speed` in m/s, `car.pressure` in Pa


@dataclass(frozen=True, slots=True)
class CircumstanceSeries:
    """Means over n points, oldest first."""

    resolution: int  # s a point
    time: list[int]  # ns since epoch, start of each
    values: dict[str, list[float | None]]  # by name; None where nobody measured it


def add_circumstances(connection: Connection, found: Mapping[str, Sequence[WindowCircumstances]], now: int) -> None:
    """Merge windows that were stored for the first time into the minutes and hours of their vehicles."""
    fresh: dict[tuple[str, int, int], Means] = {}
    for vehicle, windows in found.items():
        for ran in windows:
            for level in LEVELS if ran.values else ():
                bucket = ran.start // (level * NANOSECONDS) * (level * NANOSECONDS)
                one = {name: [1, value] for name, value in ran.values.items()}
                _merge(fresh.setdefault((vehicle, level, bucket), {}), one)
    table, places = circumstances, list(fresh)
    by = tuple_(*(table.c[name] for name in KEY))
    for first in range(0, len(places), IN_LIMIT // len(KEY)):
        for row in connection.execute(select(table).where(by.in_(places[first : first + IN_LIMIT // len(KEY)]))):
            _merge(fresh[row.vehicle_id, row.resolution_s, row.bucket_ns], row.means)
    rows = [
        {"vehicle_id": vehicle, "resolution_s": level, "bucket_ns": bucket, "means": means, "updated_ns": now}
        for (vehicle, level, bucket), means in fresh.items()
    ]
    upsert(connection, table, rows, key=KEY)


def circumstances_between(
    connection: Connection, vehicle: str, since: int, until: int, points: int
) -> CircumstanceSeries:
    """The means of since <= time < until in at most about `points` points; a point is a minute at least."""
    table = circumstances
    of_vehicle = table.c.vehicle_id == vehicle
    inside = (of_vehicle, table.c.bucket_ns >= since, table.c.bucket_ns < until, table.c.resolution_s == LEVELS[-1])
    ends = [
        connection.execute(select(table.c.bucket_ns).where(*inside).order_by(order).limit(1)).scalar()
        for order in (table.c.bucket_ns.asc(), table.c.bucket_ns.desc())
    ]
    span = 0.0 if ends[0] is None or ends[1] is None else (ends[1] - ends[0]) / NANOSECONDS + LEVELS[-1]
    wide = next((s for s in NICE if s >= LEVELS[0] and span / s <= points), NICE[-1])
    level = max(level for level in LEVELS if level <= wide)
    query = (
        select(table.c.bucket_ns, table.c.means)
        .where(of_vehicle, table.c.resolution_s == level, table.c.bucket_ns >= since - level * NANOSECONDS)
        .where(table.c.bucket_ns < until)
        .order_by(table.c.bucket_ns)
    )
    width = round(wide * NANOSECONDS)
    merged: dict[int, Means] = {}
    for bucket, means in connection.execute(query):
        _merge(merged.setdefault(bucket // width * width, {}), means)
    names = dict.fromkeys(name for means in merged.values() for name in means if not name.startswith(STANDING))
    values: dict[str, list[float | None]] = {
        name: [means[name][1] if name in means else None for means in merged.values()] for name in names
    }
    return CircumstanceSeries(round(wide), list(merged), values)


def _merge(into: Means, more: Mapping[str, Any]) -> None:
    for name, (count, mean) in more.items():
        held = into.setdefault(name, [0, 0.0])
        held[0] += count
        held[1] += (mean - held[1]) * count / held[0]
