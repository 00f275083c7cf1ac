"""The latest minute of ride comfort of vehicles that are followed, for metrics and pages."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from sprung.model import comfort
from sprung.model.tracking.tracker import TrackerState
from sprung.service.engine import Engine
from sprung.service.processed import Batch


@dataclass(frozen=True, slots=True)
class RideMinute:
    """The newest whole minute of a vehicle."""

    start: int  # ns
    sensors: dict[str, dict[str, float | None]]  # m/s^2, by sensor and quantity, see `model.comfort`
    cost: float | None  # relative change of comfort that leaving the baseline has brought, on an average track


class Rides:
    """Collects minutes of the `limit` vehicles heard from last: each holds a minute of its accelerometers."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rides: OrderedDict[str, tuple[str, comfort.RideQuality]] = OrderedDict()  # by vehicle: system, ride
        self._latest: dict[str, RideMinute] = {}
        self._lock = threading.Lock()

    def on_batch(self, batch: Batch) -> None:
        """Take the windows of a batch."""
        engine = batch.served.engine
        if not self._limit or not batch.fresh:
            return
        with self._lock:
            digest, ride = self._rides.get(batch.vehicle, ("", None))
            if ride is None or digest != engine.system.digest:
                ride = comfort.RideQuality(engine.system, most=1)
            self._rides[batch.vehicle] = (engine.system.digest, ride)
            self._rides.move_to_end(batch.vehicle)
            while len(self._rides) > self._limit:
                self._latest.pop(self._rides.popitem(last=False)[0], None)
            before = len(ride.minutes) and ride.minutes[-1].start
            for window in batch.fresh:
                if window.outcome != "dropped":
                    ride.push(window.start, window.values)
            if ride.minutes and ride.minutes[-1].start != before:
                start, sensors = ride.by_minute()[-1]
                self._latest[batch.vehicle] = RideMinute(start, sensors, cost(engine, batch.state))

    def latest(self, vehicle: str) -> RideMinute | None:
        """The newest minute of a vehicle; None before the first."""
        with self._lock:
            return self._latest.get(vehicle)

    def forget(self, vehicle: str) -> None:
        """A vehicle was deleted or taken out of service."""
        with self._lock:
            self._rides.pop(vehicle, None)
            self._latest.pop(vehicle, None)

    def all(self) -> dict[str, RideMinute]:
        """The newest minutes by vehicle."""
        with self._lock:
            return dict(self._latest)


def cost(engine: Engine, state: TrackerState) -> float | None:
    """What the changes from a vehicle's own baseline cost of comfort; None without sensors where people are."""
    reports = engine.tracker.report(state)
    now = np.array([report.log_ratio for report in reports])
    then = np.array([np.log((report.baseline or report.value) / report.nominal) for report in reports])
    return comfort.cost(engine.system, now, then)


class RideCollector(Collector):
    """Comfort of the newest minutes as metrics."""

    def __init__(self, rides: Rides) -> None:
        self._rides = rides

    def collect(self) -> Iterator[Metric]:
        """Families of all vehicles with a minute."""
        values = GaugeMetricFamily(
            "sprung_comfort_meters_per_second_squared",
            "Newest minute of a body's accelerometer: wb_rms (EN 12299), wk_rms (ISO 2631-1), "
            "en14363_peak and en14363_rms (0.4-10 Hz)",
            labels=["vehicle", "sensor", "quantity"],
        )
        costs = GaugeMetricFamily(
            "sprung_comfort_cost_ratio",
            "Relative change of the W_b-weighted acceleration on an average track since the vehicle's baseline",
            labels=["vehicle"],
        )
        for vehicle, minute in self._rides.all().items():
            for sensor, told in minute.sensors.items():
                for quantity, value in told.items():
                    if value is not None:
                        values.add_metric([vehicle, sensor, quantity], value)
            if minute.cost is not None:
                costs.add_metric([vehicle], minute.cost)
        yield from (values, costs)

    def describe(self) -> Iterator[Metric]:
        """Nothing is collected at registration."""
        return iter(())
