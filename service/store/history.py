"""Posteriors over time: raw for short ranges, roll-ups of one minute and one hour for long ones."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from sqlalchemy import Column, Connection, Table, func, literal, select, tuple_

from sprung.model.signals import FloatArray, IntArray
from sprung.service.store.archive import Archive, ArchivedPosterior
from sprung.service.store.engine import upsert
from sprung.service.store.schema import rollups, windows
from sprung.service.store.windows import IN_LIMIT, Posterior, VehicleWindows, pack, unpack
from sprung.service.times import NANOSECONDS

Older = Callable[[int, int], Iterable[ArchivedPosterior]]  # of since and until
LEVELS = (60, 3600)  # s
NICE = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 900.0, 3600.0, 6 * 3600.0, 86400.0)  # s per point


@dataclass(frozen=True, slots=True)
class HistoryPoint:
    """Posterior log-ratios of all parameters at one time, or over one bucket that starts then."""

    time: int  # ns since epoch
    windows: int
    mean: FloatArray  # shape (P,)
    std: FloatArray  # shape (P,)
    low: FloatArray  # shape (P,)
    high: FloatArray  # shape (P,)

    def merged(self, other: HistoryPoint) -> HistoryPoint:
        """Both as one bucket, at this one's time."""
        count = self.windows + other.windows
        share = other.windows / count
        return HistoryPoint(
            self.time,
            count,
            self.mean + share * (other.mean - self.mean),
            self.std + share * (other.std - self.std),
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )


Place = tuple[str, int, int, int]  # of a bucket: vehicle, model, level in s, start in ns


def add_to_rollups(connection: Connection, found: Sequence[VehicleWindows], now: int) -> None:
    """Merge windows that were stored for the first time into their buckets."""
    fresh: dict[Place, HistoryPoint] = {}
    for one in found:
        points = [_point(record.start, record.posterior) for record in one.records if record.posterior is not None]
        for level in LEVELS:
            fresh |= {(one.vehicle, one.model_id, level, point.time): point for point in bucketed(points, level)}
    for place, stored in _stored(connection, list(fresh)):
        fresh[place] = stored.merged(fresh[place])
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
        for (vehicle, model_id, level, _), point in fresh.items()
    ]
    upsert(connection, rollups, rows, key=("vehicle_id", "model_id", "resolution_s", "bucket_ns"))


@dataclass(frozen=True, slots=True)
class Series:
    """Posteriors of all parameters over n points, oldest first."""

    time: IntArray  # ns since epoch, shape (n,); start of the window or bucket
    windows: IntArray  # shape (n,)
    mean: FloatArray  # log-ratios, shape (n, P)
    std: FloatArray  # mean of the posterior's, shape (n, P)
    low: FloatArray  # smallest posterior mean within the point, shape (n, P)
    high: FloatArray  # largest, shape (n, P)


def series(
    connection: Connection,
    vehicle: str,
    model_id: int,
    since: int,
    until: int,
    resolution: float,
    limit: int,
    older: Older = lambda since, until: (),
) -> Series:
    """The newest `limit` points with since <= time < until, oldest first.

    resolution: seconds per point; below a minute made from raw windows, above from roll-ups; 0 gives raw windows.
    older: windows that the store has no more, as (start, mean, std), newest first (`older_windows`).
    """
    level = max((level for level in LEVELS if level <= resolution), default=None)
    if level is None:
        query: Any = (
            select(windows.c.start_ns, literal(1), windows.c.posterior, windows.c.posterior_std)
            .where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
            .where(windows.c.posterior.is_not(None))
            .where(windows.c.start_ns >= since, windows.c.start_ns < until)
            .order_by(windows.c.start_ns.desc())
        )
    else:
        table = rollups
        query = (
            select(table.c.bucket_ns, table.c.windows, table.c.mean, table.c.std, table.c.low, table.c.high)
            .where(table.c.vehicle_id == vehicle, table.c.model_id == model_id)
            .where(table.c.resolution_s == level, table.c.bucket_ns >= since, table.c.bucket_ns < until)
            .order_by(table.c.bucket_ns.desc())
        )
    exact = resolution == (level or 0)
    query = query.limit(limit) if exact else query
    if level is not None:
        rows_newest_first: Iterable[Any] = connection.execute(query)
    else:
        rows_newest_first = _together(connection.execute(query), older(since, until))
    if exact:
        return _of_rows(list(islice(rows_newest_first, limit)))
    width = round(resolution * NANOSECONDS)
    rows: list[Any] = []
    buckets = 0
    for row in rows_newest_first:
        buckets += not rows or rows[-1][0] // width != row[0] // width
        if buckets > limit:
            break
        rows.append(row)
    return _merged(_of_rows(rows), width)


def older_windows(archive: Archive | None, vehicle: str, digest: str) -> Older:
    """What `series` reads when the store's own windows are at their end."""
    if archive is None:
        return lambda since, until: ()
    return lambda since, until: archive.posteriors(vehicle, digest, since, until)


def _together(stored: Iterable[Any], older: Iterable[ArchivedPosterior]) -> Iterator[tuple[Any, ...]]:
    """Rows of the store and of the archive, newest first, each start once."""
    archived = ((one.start, 1, one.mean, one.std) for one in older)
    last = None
    for row in heapq.merge((tuple(row) for row in stored), archived, key=lambda row: -row[0]):
        if row[0] != last:
            last = row[0]
            yield row


def _of_rows(newest_first: Sequence[Any]) -> Series:
    """Rows of (time, windows, mean, std[, low, high])."""
    rows = newest_first[::-1]
    time = np.array([row[0] for row in rows], dtype=np.int64)
    count = np.array([row[1] for row in rows], dtype=np.int64)
    width = len(rows[0]) if rows else 4
    columns = [unpack(b"".join(row[i] for row in rows)).reshape(len(rows), -1 if rows else 0) for i in range(2, width)]
    mean, std = columns[0], columns[1]
    return Series(time, count, mean, std, *(columns[2:] or (mean, mean)))


def _merged(found: Series, width: int) -> Series:
    """Points that fall into the same bucket of `width` ns as one, at the bucket's start."""
    if not len(found.time):
        return found
    bucket = found.time // width * width
    first = np.flatnonzero(np.r_[True, bucket[1:] != bucket[:-1]])
    count = np.add.reduceat(found.windows, first)
    weight = found.windows[:, None]
    return Series(
        bucket[first],
        count,
        np.add.reduceat(found.mean * weight, first) / count[:, None],
        np.add.reduceat(found.std * weight, first) / count[:, None],
        np.minimum.reduceat(found.low, first),
        np.maximum.reduceat(found.high, first),
    )


def bucketed(points: Iterable[HistoryPoint], resolution: float) -> Iterator[HistoryPoint]:
    """Merge points in order of time, either way, that fall into the same bucket of `resolution` seconds."""
    width = round(resolution * NANOSECONDS)
    current: HistoryPoint | None = None
    for point in points:
        bucket = point.time // width * width
        placed = HistoryPoint(bucket, point.windows, point.mean, point.std, point.low, point.high)
        if current is None:
            current = placed
        elif current.time == bucket:
            current = current.merged(placed)
        else:
            yield current
            current = placed
    if current is not None:
        yield current


def _point(start: int, posterior: Posterior) -> HistoryPoint:
    mean = posterior.log_ratio
    return HistoryPoint(start, 1, mean, posterior.std, mean, mean)


def _stored(connection: Connection, places: list[Place]) -> Iterator[tuple[Place, HistoryPoint]]:
    """Stored buckets among `places`."""
    table = rollups
    by = (table.c.vehicle_id, table.c.model_id, table.c.resolution_s, table.c.bucket_ns)
    query = select(*by, table.c.windows, table.c.mean, table.c.std, table.c.low, table.c.high)
    for first in range(0, len(places), IN_LIMIT // len(by)):
        for row in connection.execute(query.where(tuple_(*by).in_(places[first : first + IN_LIMIT // len(by)]))):
            yield (row[0], row[1], row[2], row[3]), HistoryPoint(row[3], row[4], *map(unpack, row[5:]))


def fitting_resolution(
    connection: Connection, vehicle: str, model_id: int, since: int, until: int, points: int
) -> float:
    """Seconds per point that show the whole range in about `points`; 0 where every window fits."""

    def span(table: Table, time: Column[int]) -> tuple[int | None, int | None]:
        """Oldest and newest time, each one step into the index."""
        inside = select(time).where(
            table.c.vehicle_id == vehicle, table.c.model_id == model_id, time >= since, time < until
        )
        if table is rollups:
            inside = inside.where(table.c.resolution_s == LEVELS[0])
        ends = (connection.execute(inside.order_by(order).limit(1)).scalar() for order in (time.asc(), time.desc()))
        oldest, newest = ends
        return oldest, newest

    first, last = span(windows, windows.c.start_ns)
    oldest, newest = span(rollups, rollups.c.bucket_ns)
    if oldest is not None and newest is not None and (first is None or oldest < first - LEVELS[-1] * NANOSECONDS):
        seconds = (newest - oldest) / NANOSECONDS  # windows of the older part are forgotten: roll-ups have it
        return next((s for s in NICE if s >= LEVELS[0] and seconds / s <= points), NICE[-1])
    if first is None or last is None:
        return 0.0
    inside = select(literal(1)).where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    inside = inside.where(windows.c.start_ns >= since, windows.c.start_ns < until).limit(points + 1)
    if connection.execute(select(func.count()).select_from(inside.subquery())).scalar_one() <= points:
        return 0.0
    return next((s for s in NICE if (last - first) / NANOSECONDS / s <= points), NICE[-1])
