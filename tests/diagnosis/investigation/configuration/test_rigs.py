"""Wrong set-ups of rigs that are no train."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.benchmarks.setup_rigs import RIGS, ChannelErrors, Rig, RigRecord, recorded
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.measurements.common_delay import common_delay
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws.sensor_faults import SENSOR_LAG

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


@pytest.mark.slow
def test_lags_of_all_sensors_are_one_delay_where_parameters_are_far_off() -> None:
    system, values = recorded(BUILDING, np.random.default_rng([847209, 15]))
    wrong = ChannelErrors("node_delay", ("a1", "a2", "a3"), late=3)
    report = diagnose(system, RigRecord(wrong.of([c.name for c in system.channels], values), system.sample_rate))
    assert [(f.location, f.effect) for f in report.findings] == [("a1|a2|a3", "node_delay")]
    assert report.findings[0].parameters[0].value == pytest.approx(0.03, rel=0.02)


@pytest.mark.parametrize(
    ("times", "together"),
    [
        ({"a1": 0.03, "a2": 0.0301, "a3": 0.0299}, 0.03),
        ({"a1": 0.03, "a2": 0.0301}, None),
        ({"a1": 0.03, "a2": 0.0301, "a3": 0.05}, None),
        ({"a1": -0.03, "a2": -0.0301, "a3": -0.0299}, None),
        ({"a1": 0.03}, None),
    ],
)
def test_only_equal_lags_of_a_whole_group_are_one_delay(times: dict[str, float], together: float | None) -> None:
    system, values = recorded(replace(BUILDING, seconds=20.0), np.random.default_rng(3), 0.02)
    state = begun(system, RigRecord(values, system.sample_rate), Options(), lambda share, text: None)
    terms = tuple(Term(SENSOR_LAG, name, (late,)) for name, late in times.items())
    late = replace(state, fit=replace(state.fit, point=replace(state.fit.point, terms=terms)))
    found = common_delay(late)
    if together is None:
        assert found is None
    else:
        assert found is not None and found.value == pytest.approx(together) and found.site.location == "a1|a2|a3"
