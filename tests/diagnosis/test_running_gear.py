"""Rails and wheels: flats, joints and late axles, put into healthy recordings of the independent generator."""

import numpy as np
import pytest

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.model.diagnosis.api import diagnose
from sprung.model.laws import CLOCK_LEAD
from sprung.model.laws.channel import SensorResponse, passed
from sprung.model.system import MANCHESTER, load_system
from tests.named_laws import support_law

SYSTEM = load_system(MANCHESTER)
RATE = SYSTEM.sample_rate


class HealthyRecord:
    """A healthy vehicle's channels, in the order of the system's."""

    sample_rate, lost = RATE, 0

    def __init__(self, seed: int, seconds: float = 16.0) -> None:
        vehicle = read_vehicle(MANCHESTER)
        made = next(make_recordings(vehicle, draw_cases(vehicle, 1, seed, ["clean"]), seconds))
        names = [f"{w}.{q}" for q in ("displacement", "velocity") for w in vehicle.inputs] + list(vehicle.sensors)
        at = {name: i for i, name in enumerate(names)}
        self.names = [channel.name for channel in SYSTEM.channels]
        self.values = made.values[:, [at[name] for name in self.names]]

    def column(self, name: str) -> int:
        return self.names.index(name)

    def hide_dip(self, law: str, wheel: str, depth: float, frequency: float, phase: float) -> None:
        """The wheels go over a dip that their measured motion does not show; anti-aliased at 42 Hz."""
        time = np.arange(len(self.values)) / RATE + CLOCK_LEAD
        for n, weight in enumerate(support_law(law).harmonics, 1):
            if n * frequency < 42:
                angle = 2 * np.pi * n * (frequency * time - phase)
                omega = 2 * np.pi * n * frequency
                self.values[:, self.column(f"{wheel}.displacement")] -= depth * weight * np.cos(angle)
                self.values[:, self.column(f"{wheel}.velocity")] += depth * weight * omega * np.sin(angle)


def test_a_flat_on_one_wheel_is_found_named_and_sized() -> None:
    record = HealthyRecord(31)
    record.hide_dip("wheel_flat", "wheel_12r", 1e-4, 9.37, 0.3)
    report = diagnose(SYSTEM, record)
    assert [(f.location, f.effect) for f in report.findings] == [("wheel_12r", "wheel_flat")]
    depth, frequency, phase = report.findings[0].parameters
    assert abs(depth.value - 1e-4) < 4 * depth.std and depth.std < 5e-6
    assert abs(frequency.value - 9.37) < 3 * frequency.std
    assert abs(phase.value - 0.3) < 0.02


@pytest.mark.slow
def test_rail_joints_are_distinguished_from_a_flat_by_the_other_wheel() -> None:
    record = HealthyRecord(32)
    for wheel in ("wheel_21l", "wheel_21r"):
        record.hide_dip("rail_joints", wheel, 3e-4, 1.7, 0.6)
    report = diagnose(SYSTEM, record)
    assert [(f.location, f.effect) for f in report.findings] == [("wheel_21l|wheel_21r", "rail_joints")]
    depth = report.findings[0].parameters[0]
    assert abs(depth.value - 3e-4) < 4 * depth.std


@pytest.mark.slow
def test_a_late_axle_is_a_fault_of_the_measurement() -> None:
    record = HealthyRecord(33)
    for wheel in ("wheel_21l", "wheel_21r"):
        for quantity in ("displacement", "velocity"):
            i = record.column(f"{wheel}.{quantity}")
            record.values[:, i] = passed(record.values[:, i], SensorResponse(delay=0.002), RATE)
    report = diagnose(SYSTEM, record)
    assert report.verdict == "sensor_fault"
    assert [(f.location, f.effect) for f in report.findings] == [("wheel_21l|wheel_21r", "axle_delay")]
    time = report.findings[0].parameters[0]
    assert time.value == pytest.approx(0.002, abs=max(4 * time.std, 1e-5))
