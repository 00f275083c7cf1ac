"""Prometheus metrics: one registry per application, series bounded by a budget of vehicles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from sprung.model.signals import Tally
from sprung.service.monitoring.board import Board, Entry
from sprung.service.store.status import HEALTHS
from sprung.service.times import NANOSECONDS

STAGE_BUCKETS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
VALUES = {
    "stiffness": ("sprung_stiffness_newtons_per_meter", "Stiffness, posterior mean"),
    "damping": ("sprung_damping_newton_seconds_per_meter", "Damping coefficient, posterior mean"),
    "mass": ("sprung_mass_kilograms", "Mass, posterior mean"),
}


class Metrics:
    """Everything that `GET /metrics` shows."""

    def __init__(self, board: Board, parameter_vehicles: int, fleet: Callable[[], Mapping[str, int]] = dict) -> None:
        """fleet: counts of all vehicles in service by health, from the store."""
        self.registry = CollectorRegistry()
        self.registry.register(FleetCollector(board, parameter_vehicles, fleet))
        for added in entry_points(group="sprung.metrics"):  # of other packages: a function (board) -> Collector
            self.registry.register(added.load()(board))
        self.frames = Counter(
            "sprung_frames_total",
            "Messages read, by what became of them",
            ["source", "outcome"],
            registry=self.registry,
        )
        self.duration = Histogram(
            "sprung_identify_duration_seconds",
            "Time from a window to its stored estimate, by stage",
            ["stage"],
            registry=self.registry,
            buckets=STAGE_BUCKETS,
        )

    def observe(self, seconds: Mapping[str, float]) -> None:
        """Durations of stages."""
        for stage, value in seconds.items():
            self.duration.labels(stage).observe(value)

    def count_frames(self, source: str, before: Tally, now: Tally) -> None:
        """Add what a source has read since `before`."""
        old = before.as_dict()
        for outcome, total in now.as_dict().items():
            self.frames.labels(source, outcome).inc(total - old[outcome])

    def render(self) -> bytes:
        """The text exposition format."""
        return generate_latest(self.registry)


class FleetCollector(Collector):
    """Reads the board at every scrape, so that a vehicle which is forgotten leaves no series behind.

    Per-parameter and per-sensor series (about 110 a vehicle of 24 parameters) are given for as many vehicles as the
    budget allows: those with alarms first, then those heard from most recently.  The history of all is in the store.
    """

    def __init__(self, board: Board, parameter_vehicles: int, fleet: Callable[[], Mapping[str, int]]) -> None:
        self._board = board
        self._budget = parameter_vehicles
        self._fleet = fleet

    def collect(self) -> Iterator[Metric]:
        """Families of the service, of all vehicles, then of those within the budget."""
        entries = self._board.entries()
        counts = GaugeMetricFamily("sprung_fleet_vehicles", "Vehicles in service by health", labels=["health"])
        for health, count in self._fleet().items():
            counts.add_metric([health], count)
        yield counts
        yield from _vehicle_families(entries)
        yield from _parameter_families(entries[: self._budget])

    def describe(self) -> Iterator[Metric]:
        """Nothing is collected at registration."""
        return iter(())


def _vehicle_families(entries: list[Entry]) -> Iterator[Metric]:
    windows = CounterMetricFamily("sprung_windows", "Windows by outcome", labels=["vehicle", "outcome"])
    reasons = CounterMetricFamily("sprung_windows_dropped", "Dropped windows by reason", labels=["vehicle", "reason"])
    alarms = GaugeMetricFamily("sprung_alarms_active", "Alarms that are active", labels=["vehicle", "severity"])
    kinds = GaugeMetricFamily("sprung_alarms_active_by_kind", "Alarms that are active", labels=["vehicle", "kind"])
    names = ", ".join(f"{rank} {health}" for rank, health in enumerate(HEALTHS))
    health = GaugeMetricFamily("sprung_vehicle_health", f"NAMUR NE 107: {names}", labels=["vehicle"])
    drift = GaugeMetricFamily(
        "sprung_vehicle_largest_drift_ratio", "The largest drift from baseline, with its sign", labels=["vehicle"]
    )
    last = GaugeMetricFamily(
        "sprung_last_window_timestamp_seconds", "Start of the newest window, as recorded", labels=["vehicle"]
    )
    received = GaugeMetricFamily(
        "sprung_last_received_timestamp_seconds", "When the newest window came, by this machine", labels=["vehicle"]
    )
    for entry in entries:
        view = entry.view
        for outcome, count in entry.windows.items():
            windows.add_metric([view.vehicle, outcome], count)
        for reason, count in entry.reasons.items():
            reasons.add_metric([view.vehicle, reason], count)
        for severity, count in view.active_by_severity().items():
            alarms.add_metric([view.vehicle, severity], count)
        for kind, count in view.active_by_kind().items():
            kinds.add_metric([view.vehicle, kind], count)
        health.add_metric([view.vehicle], HEALTHS.index(view.health))
        if view.largest is not None and view.largest.drift is not None:
            drift.add_metric([view.vehicle], view.largest.drift)
        if view.last_window_ns is not None:
            last.add_metric([view.vehicle], view.last_window_ns / NANOSECONDS)
        received.add_metric([view.vehicle], entry.received_ns / NANOSECONDS)
    yield from (windows, reasons, alarms, kinds, health, drift, last, received)


def _parameter_families(entries: list[Entry]) -> Iterator[Metric]:
    values = {
        quantity: GaugeMetricFamily(name, text, labels=["vehicle", "element"])
        for quantity, (name, text) in VALUES.items()
    }
    labels = ["vehicle", "element", "quantity"]
    ratio = GaugeMetricFamily("sprung_parameter_ratio", "Estimate over the vehicle's own baseline", labels=labels)
    spread = GaugeMetricFamily(
        "sprung_parameter_ratio_stddev", "Standard deviation of sprung_parameter_ratio", labels=labels
    )
    fit = GaugeMetricFamily("sprung_fit_nrmse", "rms(error) / rms(measured)", labels=["vehicle", "sensor"])
    wrong = GaugeMetricFamily(
        "sprung_sensor_fault",
        "1 for what is wrong with a measurement; channels that share it are joined by |",
        labels=["vehicle", "channel", "kind"],
    )
    for entry in entries:
        view = entry.view
        for p in view.parameters:
            if p.identifiable and p.quantity in values:
                values[p.quantity].add_metric([view.vehicle, p.element], p.value)
            if p.drift is not None and p.drift_std is not None:
                ratio.add_metric([view.vehicle, p.element, p.quantity], 1.0 + p.drift)
                spread.add_metric([view.vehicle, p.element, p.quantity], p.drift_std)
        for sensor, nrmse in view.per_sensor.items() if view.fits else ():
            fit.add_metric([view.vehicle, sensor], nrmse)
        for fault in view.sensors:
            wrong.add_metric([view.vehicle, fault.channel, fault.kind], 1)
    yield from (*values.values(), ratio, spread, fit, wrong)
