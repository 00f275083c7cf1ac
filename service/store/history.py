"""Posteriors over time: raw for short ranges, roll-ups of one minute and one hour for long ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Column, Connection, Table, func, select

from sprung.model.signals import FloatArray
from sprung.service.store.engine import upsert
from sprung.service.store.schema import posteriors, rollups, windows
from sprung.service.store.windows import WindowRecord, pack, unpack
from sprung.service.times import NANOSECONDS

LEVELS = (60, 3600)  # s
NICE = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 900.0, 3600.0, 6 * 3600.0, 86400.0)  # s per point


@dataclass(frozen=True, slots=True)
class Point:
    """Posterior log-ratios of all parameters at one time, or over one bucket that starts then."""

    time: int  # ns since epoch
    windows: int
    mean: FloatArray  # shape (P,)
    std: FloatArray  # shape (P,)
    low: FloatArray  # shape (P,)
    high: FloatArray  # shape (P,)

    def merged(self, other: Point) -> Point:
        """Both as one bucket, at this one's time."""
        count = self.windows + other.windows
        share = other.windows / count
        return Point(
            self.time,
            count,
            self.mean + share * (other.mean - self.mean),
            self.std + share * (other.std - self.std),
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )


def add_to_rollups(
    connection: Connection, vehicle: str, model_id: int, records: Sequence[WindowRecord], now: int
) -> None:
    """Merge windows that were stored for the first time into their buckets."""
    points = [
        Point(r.start, 1, r.posterior.log_ratio, r.posterior.std, r.posterior.log_ratio, r.posterior.log_ratio)
        for r in records
        if r.posterior is not None
    ]
    for level in LEVELS:
        fresh = {point.time: point for point in bucketed(points, level)}
        for stored in _stored(connection, vehicle, model_id, level, list(fresh)):
            fresh[stored.time] = stored.merged(fresh[stored.time])
        rows = [
            {
                "vehicle_id": vehicle,
                "model_id": model_id,
                "resolution_s": level,
                "bucket_ns": point.time,
                "windows": point.windows,
                "mean": pack(point.mean),
                "std": pack(point.std),
                "low": pack(point.low),
                "high": pack(point.high),
                "updated_ns": now,
            }
            for point in fresh.values()
        ]
        upsert(connection, rollups, rows, key=("vehicle_id", "model_id", "resolution_s", "bucket_ns"))


def history(
    connection: Connection,
    vehicle: str,
    model_id: int,
    since: int,
    until: int,
    resolution: float,
    limit: int,
) -> list[Point]:
    """The newest `limit` points with since <= time < until, oldest first.

    resolution: seconds per point; below a minute made from raw windows, above from roll-ups; 0 gives raw windows.
    """
    level = max((level for level in LEVELS if level <= resolution), default=None)
    newest_first: Iterator[Point]
    if level is None:
        query = (
            select(windows.c.start_ns, posteriors.c.log_ratio, posteriors.c.std)
            .join(posteriors, posteriors.c.window_id == windows.c.id)
            .where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
            .where(windows.c.start_ns >= since, windows.c.start_ns < until)
            .order_by(windows.c.start_ns.desc())
        )
        newest_first = (_raw_point(row.start_ns, row.log_ratio, row.std) for row in connection.execute(query))
    else:
        table = rollups
        query = (
            select(table.c.bucket_ns, table.c.windows, table.c.mean, table.c.std, table.c.low, table.c.high)
            .where(table.c.vehicle_id == vehicle, table.c.model_id == model_id)
            .where(table.c.resolution_s == level, table.c.bucket_ns >= since, table.c.bucket_ns < until)
            .order_by(table.c.bucket_ns.desc())
        )
        newest_first = (Point(row[0], row[1], *map(unpack, row[2:])) for row in connection.execute(query))
    if resolution > (level or 0):
        newest_first = bucketed(newest_first, resolution)
    found = []
    for point in newest_first:
        found.append(point)
        if len(found) == limit:
            break
    return found[::-1]


def bucketed(points: Iterable[Point], resolution: float) -> Iterator[Point]:
    """Merge points in order of time, either way, that fall into the same bucket of `resolution` seconds."""
    width = round(resolution * NANOSECONDS)
    current: Point | None = None
    for point in points:
        bucket = point.time // width * width
        placed = Point(bucket, point.windows, point.mean, point.std, point.low, point.high)
        if current is None:
            current = placed
        elif current.time == bucket:
            current = current.merged(placed)
        else:
            yield current
            current = placed
    if current is not None:
        yield current


def _raw_point(time: int, log_ratio: bytes, std: bytes) -> Point:
    mean = unpack(log_ratio)
    return Point(time, 1, mean, unpack(std), mean, mean)


def _stored(connection: Connection, vehicle: str, model_id: int, level: int, buckets: list[int]) -> list[Point]:
    table = rollups
    query = (
        select(table.c.bucket_ns, table.c.windows, table.c.mean, table.c.std, table.c.low, table.c.high)
        .where(table.c.vehicle_id == vehicle, table.c.model_id == model_id, table.c.resolution_s == level)
        .where(table.c.bucket_ns.in_(buckets))
    )
    return [Point(row[0], row[1], *map(unpack, row[2:])) for row in connection.execute(query)]


def fitting_resolution(
    connection: Connection, vehicle: str, model_id: int, since: int, until: int, points: int
) -> float:
    """Seconds per point that show the whole range in about `points`; 0 where every window fits."""

    def spans(table: Table, time: Column[int]) -> Any:
        inside = (table.c.vehicle_id == vehicle, table.c.model_id == model_id, time >= since, time < until)
        return connection.execute(select(func.count(), func.min(time), func.max(time)).where(*inside)).one()

    count, first, last = spans(windows, windows.c.start_ns)
    buckets, oldest, newest = spans(rollups, rollups.c.bucket_ns)
    if buckets and (not count or oldest < first - LEVELS[-1] * NANOSECONDS):
        seconds = (newest - oldest) / NANOSECONDS  # windows of the older part are forgotten: roll-ups have it
        return next((s for s in NICE if s >= LEVELS[0] and seconds / s <= points), NICE[-1])
    if count <= points:
        return 0.0
    return next((s for s in NICE if (last - first) / NANOSECONDS / s <= points), NICE[-1])
