"""Cache of the fleet's statistics for ten minutes: they change over days and read much data."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from sprung.service.fleet.knowledge import FleetKnowledge, Standing, fastest, knowledge, sure_slope, worst
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.views import known_limit
from sprung.service.store import Store
from sprung.service.store.levels import fleet_levels
from sprung.service.times import NANOSECONDS, now_ns, to_iso

DAYS = 60
AHEAD_DAYS = (30, 90, 365)
FRESH_SECONDS = 600.0
MOST_POINTS = 60  # of a vehicle
DAY = 86_400 * NANOSECONDS


class FleetStatistics:
    """Safe to share between threads."""

    def __init__(self, engine: Engine, store: Store, model_id: int) -> None:
        self._engine = engine
        self._store = store
        self._model_id = model_id
        self._lock = threading.Lock()
        self._held: dict[tuple[str, int], tuple[float, FleetKnowledge]] = {}

    def known(self, prefix: str = "", days: int = DAYS) -> FleetKnowledge:
        """As of the last ten minutes, from roll-ups of the last `days`; of vehicles whose ids begin with `prefix`."""
        with self._lock:
            now = time.monotonic()
            self._held = {key: held for key, held in self._held.items() if now - held[0] < FRESH_SECONDS}
            if (prefix, days) not in self._held:
                self._held[prefix, days] = (now, self._computed(prefix, days))
            return self._held[prefix, days][1]

    def _computed(self, prefix: str, days: int) -> FleetKnowledge:
        now, tracker = now_ns(), self._engine.tracker
        with self._store.read() as connection:
            found = fleet_levels(connection, self._model_id, now - days * DAY, now, min(days, MOST_POINTS), prefix)
        names = [p.name for p in self._engine.system.tracked]
        return knowledge(
            found, names, known_limit(self._engine), float(np.log1p(tracker.settings.alarm_change)), AHEAD_DAYS
        )


def knowledge_dict(found: FleetKnowledge, limit: int) -> dict[str, Any]:
    """JSON of `GET /fleet/knowledge`."""
    crossing = [one for one in found.standings if np.isfinite(one.slope)]
    expected = {
        str(days): round(float(sum(one.crossed[i] for one in crossing)), 2) for i, days in enumerate(AHEAD_DAYS)
    }
    usual = [
        {"kind": u.kind, "vehicle_class": u.vehicle_class, "vehicles": u.vehicles}
        | {"ratio": float(np.exp(u.mean)), "mean_std": u.mean_std, "own_std": u.own_std, "class_std": u.class_std}
        for u in found.usual
    ]
    common = [
        {"vehicle_class": c.vehicle_class, "kind": c.kind, "time": to_iso(c.time), "change": c.change, "std": c.std}
        | {"temperature": c.temperature if np.isfinite(c.temperature) else None}
        for c in found.common
    ]
    temperature = [
        {"vehicle_class": t.vehicle_class, "kind": t.kind, "days": t.days}
        | {"per_kelvin": t.per_kelvin, "std": t.std, "explained": t.explained}
        for t in found.temperature
    ]
    return {
        "parameters": len(found.standings),
        "usual": usual,
        "worst": [standing_dict(one) for one in worst(found.standings, limit)],
        "fastest": [standing_dict(one) for one in fastest(found.standings, limit)],
        "common": common,
        "temperature": temperature,
        "expected_crossings": expected,
    }


def standing_dict(one: Standing) -> dict[str, Any]:
    """JSON of one parameter of one vehicle."""
    moves = bool(np.isfinite(one.slope))
    return {
        "vehicle": one.vehicle,
        "parameter": one.parameter,
        "ratio": float(np.exp(one.level)),
        "std": one.std,
        "usual_ratio": float(np.exp(one.usual)),
        "departure": one.departure,
        "per_day": one.slope if moves else None,
        "per_day_std": one.slope_std if moves else None,
        "per_day_sure": sure_slope(one) if moves else None,
        "crossing_days": list(one.crossing_days),
    }
