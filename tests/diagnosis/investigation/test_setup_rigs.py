"""Wrong set-ups of rigs that are no train."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.benchmarks.setup_rigs import RIGS, ChannelErrors, Rig, RigRecord, recorded
from sprung.model.diagnosis.api import diagnose

HALF_CAR, BUILDING, _ = RIGS
SECONDS = {"half_car.yaml": 12.0, "building.yaml": 30.0}
SPREAD = {"half_car.yaml": 0.08, "building.yaml": 0.02}  # of the parameters
FRONT = ("road_front.displacement", "road_front.velocity")


@pytest.mark.parametrize(
    ("rig", "wrong", "value"),
    [
        (HALF_CAR, ChannelErrors("node_delay", FRONT, late=3), 0.03),  # one wheel alone below its axle
        pytest.param(
            BUILDING, ChannelErrors("node_delay", ("table.acceleration",), late=5), 0.05, marks=pytest.mark.slow
        ),
        pytest.param(BUILDING, ChannelErrors("node_delay", ("a1", "a2", "a3"), late=3), 0.03, marks=pytest.mark.slow),
        (BUILDING, ChannelErrors("wrong_scale", ("table.acceleration",), factor=1 / 9.80665), 1 / 9.80665),
    ],
)
def test_a_wrong_set_up_is_named_at_its_channels(rig: Rig, wrong: ChannelErrors, value: float) -> None:
    system, values = recorded(replace(rig, seconds=SECONDS[rig.file]), np.random.default_rng(3), SPREAD[rig.file])
    record = RigRecord(wrong.of([channel.name for channel in system.channels], values), system.sample_rate)
    report = diagnose(system, record)
    assert report.verdict == "sensor_fault", report.summary
    (first,) = report.findings
    assert (first.effect, first.location) == (wrong.effect, "|".join(wrong.channels))
    assert first.parameters[0].value == pytest.approx(value, rel=0.04)
