"""When a vehicle stood: the points of a history within which no window told anything of its parameters.

There the tracker goes on with what it believed, so that posteriors alone look as if it had been measured.
"""

from __future__ import annotations

from sqlalchemy import Connection, and_, case, func, select

from sprung.service.store.history import LEVELS
from sprung.service.store.schema import circumstances, rollups, windows
from sprung.service.times import NANOSECONDS

UNINFORMATIVE = "uninformative"
STANDING = "standing:"  # with a model's number behind it: how windows that told nothing are counted a minute and hour


def counted(outcome: str, model_id: int) -> dict[str, float]:
    """What a window adds to its minute and hour in `circumstances`; nothing where it told something."""
    return {f"{STANDING}{model_id}": 1.0} if outcome == UNINFORMATIVE else {}


def standing_points(
    connection: Connection, vehicle: str, model_id: int, since: int, until: int, resolution: float, most: int
) -> list[int]:
    """Times of `history.series`, ns, of the points in which every window was uninformative; the newest `most`.

    resolution: s a point, as of the series.  What has gone to an archive, and minutes that were counted before this
    was counted, are not known to be of a standing vehicle.
    """
    level = max((level for level in LEVELS if level <= resolution), default=None)
    if level is None:
        return _of_windows(connection, vehicle, model_id, since, until, resolution, most)
    table, ran = rollups, circumstances
    same = and_(
        ran.c.vehicle_id == table.c.vehicle_id,
        ran.c.resolution_s == table.c.resolution_s,
        ran.c.bucket_ns == table.c.bucket_ns,
    )
    query = (
        select(table.c.bucket_ns, table.c.windows, ran.c.means)
        .select_from(table.outerjoin(ran, same))
        .where(table.c.vehicle_id == vehicle, table.c.model_id == model_id, table.c.resolution_s == level)
        .where(table.c.bucket_ns >= since, table.c.bucket_ns < until)
        .order_by(table.c.bucket_ns)
    )
    width = round(resolution * NANOSECONDS)
    stood: dict[int, bool] = {}
    for bucket, count, means in connection.execute(query):
        point = bucket // width * width
        still = (means or {}).get(f"{STANDING}{model_id}", (0,))[0] >= count
        stood[point] = stood.get(point, True) and still
    return [point for point, still in stood.items() if still][-most:]


def _of_windows(
    connection: Connection, vehicle: str, model_id: int, since: int, until: int, resolution: float, most: int
) -> list[int]:
    width = round(resolution * NANOSECONDS)
    time = windows.c.start_ns
    point = time - time % width if width else time
    informative = func.max(case((windows.c.outcome == UNINFORMATIVE, 0), else_=1))
    query = (
        select(point)
        .where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id, windows.c.posterior.is_not(None))
        .where(time >= since, time < until)
        .group_by(point)
        .having(informative == 0)
        .order_by(point.desc())
        .limit(most)
    )
    return sorted(connection.execute(query).scalars())
