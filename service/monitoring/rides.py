"""The latest minute of ride comfort of vehicles that are followed, for metrics and pages."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from sprung.model import comfort
from sprung.model.tracking.tracker import TrackerState
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.places import Places
from sprung.service.monitoring.processed import Batch

SILENT_SECONDS = 120.0  # after which a vehicle makes room for another


@dataclass(frozen=True, slots=True)
class RideMinute:
    """The newest whole minute of a vehicle."""

    start: int  # ns
    sensors: dict[str, dict[str, float | None]]  # m/s^2, by sensor and quantity, see `model.comfort`
    cost: float | None  # relative change of comfort that leaving the baseline has brought, on an average track


@dataclass(frozen=True)
class _WholeMinute:
    """A minute that has ended, for whoever asks: the minutes of all vehicles may end at the same moment, and windows do
    not wait until the comfort of every one is foreseen."""

    start: int
    sensors: dict[str, dict[str, float | None]]
    engine: Engine
    state: TrackerState

    @cached_property
    def told(self) -> RideMinute:
        """Takes some 10 ms the first time."""
        return RideMinute(self.start, self.sensors, cost(self.engine, self.state))


class Rides:
    """Collects minutes of `limit` vehicles, see `Places`: each holds a minute of its accelerometers."""

    def __init__(self, limit: int) -> None:
        self._rides: Places[_Ride] = Places(limit, SILENT_SECONDS)
        self._lock = threading.Lock()

    def on_batch(self, batch: Batch) -> None:
        """Take the windows of a batch."""
        if not batch.fresh:
            return
        with self._lock:
            ride = self._rides.heard(batch.vehicle, _Ride)
            if ride is not None:
                ride.take(batch)

    def latest(self, vehicle: str) -> RideMinute | None:
        """The newest minute of a vehicle; None before the first.  Not for an event loop: see `_WholeMinute`."""
        with self._lock:
            ride = self._rides.get(vehicle)
            minute = None if ride is None else ride.latest
        return None if minute is None else minute.told

    def forget(self, vehicle: str) -> None:
        """A vehicle was deleted or taken out of service."""
        with self._lock:
            self._rides.pop(vehicle)

    def all(self) -> dict[str, RideMinute]:
        """The newest minutes by vehicle; as `latest`."""
        with self._lock:
            whole = {vehicle: ride.latest for vehicle, ride in self._rides.all().items()}
        return {vehicle: minute.told for vehicle, minute in whole.items() if minute is not None}


class _Ride:
    """One vehicle's."""

    def __init__(self) -> None:
        self._digest = ""  # of the system that the minute is of
        self._quality: comfort.RideQuality | None = None
        self.latest: _WholeMinute | None = None

    def take(self, batch: Batch) -> None:
        engine, ride = batch.served.engine, self._quality
        if ride is None or self._digest != engine.system.digest:
            self._digest = engine.system.digest
            ride = self._quality = comfort.RideQuality(engine.system, most=1)
        before = len(ride.minutes) and ride.minutes[-1].start
        for window in batch.fresh:
            if window.outcome != "dropped":
                ride.push(window.start, window.values)
        if ride.minutes and ride.minutes[-1].start != before:
            start, sensors = ride.by_minute()[-1]
            self.latest = _WholeMinute(start, sensors, engine, batch.state)


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
            for sensor, by_quantity in minute.sensors.items():
                for quantity, value in by_quantity.items():
                    if value is not None:
                        values.add_metric([vehicle, sensor, quantity], value)
            if minute.cost is not None:
                costs.add_metric([vehicle], minute.cost)
        yield from (values, costs)

    def describe(self) -> Iterator[Metric]:
        """Nothing is collected at registration."""
        return iter(())
