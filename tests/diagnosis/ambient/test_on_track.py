"""A vehicle on a track that nobody measures, diagnosed from its sensors and its speed."""

import numpy as np
import pytest

from sprung.benchmarks.generator.ride import DrawnRide, draw_ride, record
from sprung.model.diagnosis.api import RecordedPart, diagnose
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.signals import FloatArray
from sprung.model.system import BUNDLED, parse_system

SYSTEM = parse_system((BUNDLED / "accelerometers.yaml").read_text() + "\nspeed: {csv: v, noise: 0.1}\n")


def ride(seconds: float) -> tuple[DrawnRide, FloatArray]:
    rng = np.random.default_rng(12)
    drawn = draw_ride(rng, speed=(42.0, 42.0))
    values = record(rng, drawn, seconds)
    return drawn, np.column_stack([drawn.speed + 0.1 * rng.normal(size=len(values)), values])


def test_sensors_and_speed_of_a_vehicle_on_a_track_are_distinguished() -> None:
    rng = np.random.default_rng(3)
    values = np.column_stack([np.full(1000, 42.0), rng.normal(size=(1000, len(SYSTEM.sensors)))])
    signals = prepare(SYSTEM, values, 100.0).signals
    assert signals.sensor_names == tuple(SYSTEM.sensors)
    np.testing.assert_array_equal(signals.sensors, values[:, 1:])
    np.testing.assert_array_equal(signals.part(10, 20).speed[:, 0], 42.0)
    assert signals.force.shape == signals.displacement.shape == (1000, 0)


@pytest.mark.slow
def test_a_healthy_vehicle_on_an_unmeasured_track_is_consistent_and_its_values_are_reported() -> None:
    drawn, values = ride(180.0)
    report = diagnose(SYSTEM, RecordedPart(100.0, values, 0))
    assert report.verdict == "consistent" and not report.findings
    found = np.array([[p.value / p.nominal, p.std / p.value] for p in report.baseline])
    told = found[:, 1] < 0.3
    assert told.sum() >= 20
    score = (np.log(found[:, 0]) - drawn.log_ratio)[told] / found[told, 1]
    assert np.sqrt(np.mean(score**2)) < 1.6 and np.abs(score).max() < 5
