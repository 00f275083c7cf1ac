"""The parameters of a whole fleet over time, as arrays: a few points a vehicle, chosen by the database."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection, func, select

from sprung.model.signals import FloatArray, IntArray
from sprung.service.store.schema import circumstances, rollups, vehicles
from sprung.service.store.windows import unpack
from sprung.service.times import NANOSECONDS

HOUR_LEVEL = 3600  # s: of the roll-ups that are read


@dataclass(frozen=True, slots=True)
class FleetLevels:
    """Log-ratios to nominal of V vehicles at N times of each; NaN where there is no point."""

    vehicles: tuple[str, ...]
    time: IntArray  # ns since epoch, shape (V, N), start of an hour; 0 where there is no point
    level: FloatArray  # shape (V, N, P)
    std: FloatArray  # shape (V, N, P), mean of the posterior's within the hour
    temperature: FloatArray | None = None  # degC, mean of the hour, shape (V, N); NaN where nobody measured it


def fleet_levels(
    connection: Connection, model_id: int, since: int, until: int, points: int, prefix: str = ""
) -> FleetLevels:
    """The last hour that is known in each of `points` equal parts of the time, of every vehicle in service."""
    width = max((until - since) // points, HOUR_LEVEL * NANOSECONDS)
    part = (rollups.c.bucket_ns - since) // width
    own = (
        rollups.c.model_id == model_id,
        rollups.c.resolution_s == HOUR_LEVEL,
        rollups.c.bucket_ns >= since,
        rollups.c.bucket_ns < until,
    )
    newest = select(rollups.c.vehicle_id, func.max(rollups.c.bucket_ns).label("bucket_ns")).where(*own)
    if prefix:
        newest = newest.where(func.substr(rollups.c.vehicle_id, 1, len(prefix)) == prefix)
    last = newest.group_by(rollups.c.vehicle_id, part).subquery()
    ran = (
        (circumstances.c.vehicle_id == rollups.c.vehicle_id)
        & (circumstances.c.bucket_ns == rollups.c.bucket_ns)
        & (circumstances.c.resolution_s == HOUR_LEVEL)
    )
    query = (
        select(rollups.c.vehicle_id, rollups.c.bucket_ns, rollups.c.mean, rollups.c.std, circumstances.c.means)
        .join(last, (last.c.vehicle_id == rollups.c.vehicle_id) & (last.c.bucket_ns == rollups.c.bucket_ns))
        .join(vehicles, vehicles.c.id == rollups.c.vehicle_id)
        .outerjoin(circumstances, ran)
        .where(rollups.c.model_id == model_id, rollups.c.resolution_s == HOUR_LEVEL, vehicles.c.retired_ns.is_(None))
        .order_by(rollups.c.vehicle_id, rollups.c.bucket_ns)
    )
    rows = connection.execute(query).all()
    names = tuple(dict.fromkeys(row.vehicle_id for row in rows))
    size = len(unpack(rows[0].mean)) if rows else 0
    shape = (len(names), points + 1)
    time = np.zeros(shape, dtype=np.int64)
    level, std = np.full((*shape, size), np.nan), np.full((*shape, size), np.nan)
    temperature = np.full(shape, np.nan)
    at = {name: [i, 0] for i, name in enumerate(names)}
    for row in rows:
        place = at[row.vehicle_id]
        if place[1] <= points:
            time[*place], level[*place], std[*place] = row.bucket_ns, unpack(row.mean), unpack(row.std)
            if row.means and "temperature" in row.means:
                temperature[*place] = row.means["temperature"][1]
            place[1] += 1
    return FleetLevels(names, time, level, std, temperature)
