"""How far two stores of the same windows are from each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy import select

from sprung.service.store import Store, fleet, history
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.schema import models, windows


def differences(one: Store, other: Store, digest: str, vehicles: list[str]) -> dict[str, Any]:
    """How far two stores are from each other."""
    found: dict[str, Any] = {"windows": 0, "alarms": 0, "alarms_of": 0, "posteriors": 0.0, "states": 0}
    for vehicle in vehicles:
        sides = [_content(store, digest, vehicle) for store in (one, other)]
        (rows, alarms, means, state), (rows_, alarms_, means_, state_) = sides
        found["windows"] += len(set(rows) ^ set(rows_))
        found["alarms"] += len(set(alarms) ^ set(alarms_))
        found["alarms_of"] += len(alarms)
        found["states"] += state != state_
        same = means.shape == means_.shape
        found["posteriors"] = max(found["posteriors"], float(np.abs(means - means_).max()) if same else np.inf)
    return found


def _content(store: Store, digest: str, vehicle: str) -> tuple[Any, ...]:
    with store.read() as connection:
        model = connection.execute(select(models.c.id).where(models.c.digest == digest)).scalar_one()
        columns = (windows.c.start_ns, windows.c.outcome, windows.c.tracked, windows.c.log_ratio, windows.c.std)
        rows = connection.execute(select(*columns).where(windows.c.vehicle_id == vehicle)).all()
        listed = fleet.list_alarms(connection, WantedAlarms(vehicle), 10_000)
        series = history.series(connection, vehicle, model, 0, 2**62, 0, 10**6)
        tracker = fleet.load_tracker(connection, vehicle, model)
    alarms = [(a.kind, a.parameter, a.opened, a.onset, a.closed, a.severity, a.change, a.std) for a in listed]
    means = np.concatenate([series.mean, series.std], axis=1)
    return [tuple(row) for row in rows], alarms, means, None if tracker is None else tracker.state
