"""What may be wrong between a rig and its channels: of all hypotheses, the one that was put in leaves least."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.configuration.effects import Hypothesis
from sprung.model.diagnosis.investigation.configuration.hypotheses import Wiring, hypotheses
from sprung.model.diagnosis.investigation.configuration.response import Group, ModelResponse
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Signals, declared_noise, transform
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.rules import RULES
from sprung.model.system import load_system
from tests.diagnosis_cases import quarter_car, simulate, true_log_ratios

SYSTEM = quarter_car()
LATE = 4  # samples


@pytest.fixture(scope="module")
def signals() -> Signals:
    return prepare(SYSTEM, simulate(seed=31).values, 100.0).signals


def ranked(signals: Signals) -> list[Hypothesis]:
    """Hypotheses about signals of the simulated springs and dampers, by the misfit that they leave."""
    noise = declared_noise(SYSTEM, signals)
    problem = Problem(SYSTEM, transform(signals, noise), signals.sensor_index, noise)
    forward = problem.forward(Point(true_log_ratios(SYSTEM), (), np.zeros(4)))
    found = hypotheses(ModelResponse.of(problem, forward), SYSTEM, signals, RULES.setup)
    return sorted(found, key=lambda one: one.misfit)


def with_sensors(signals: Signals, sensors: np.ndarray) -> Signals:
    return replace(signals, sensors=sensors)


def test_a_sensor_of_the_other_sign_is_one(signals: Signals) -> None:
    best = ranked(with_sensors(signals, signals.sensors * [1, 1, -1, 1]))[0]
    assert (best.effect.name, best.site.location) == ("sign_reversed", signals.sensor_names[2])


def test_two_exchanged_sensors_are_named_together(signals: Signals) -> None:
    best = ranked(with_sensors(signals, signals.sensors[:, [2, 1, 0, 3]]))[0]
    assert best.effect.name == "channels_swapped"
    assert set(best.site.location.split("|")) == {signals.sensor_names[0], signals.sensor_names[2]}


def test_a_late_node_is_named_with_its_delay(signals: Signals) -> None:
    late = signals.sensors.copy()
    late[LATE:, :2] = signals.sensors[:-LATE, :2]
    best = ranked(with_sensors(signals, late))[0]
    assert best.effect.name == "node_delay" and set(best.site.location.split("|")) == set(signals.sensor_names[:2])
    assert best.value == pytest.approx(LATE / 100.0, abs=1e-3)


def test_sensors_in_another_unit_are_named_with_the_ratio(signals: Signals) -> None:
    best = ranked(with_sensors(signals, signals.sensors * [1, 1, 0.4, 0.4]))[0]
    assert best.effect.name == "wrong_scale" and set(best.site.location.split("|")) == set(signals.sensor_names[2:])
    assert best.value == pytest.approx(0.4, rel=0.01)


def test_what_is_undone_is_what_was_wrong(signals: Signals) -> None:
    wrong = with_sensors(signals, signals.sensors * [1, -1, 1, 1])
    _, right = ranked(wrong)[0].undo(SYSTEM, wrong)
    np.testing.assert_array_equal(right.sensors, signals.sensors)


def test_no_hypothesis_explains_a_right_set_up(signals: Signals) -> None:
    """What is left is noise, of which the gain or lag of a single sensor takes a little."""
    noise = declared_noise(SYSTEM, signals)
    problem = Problem(SYSTEM, transform(signals, noise), signals.sensor_index, noise)
    response = ModelResponse.of(problem, problem.forward(Point(true_log_ratios(SYSTEM), (), np.zeros(4))))
    least = min(one.misfit for one in ranked(signals) if not one.effect.ordinary)
    assert least > RULES.setup.explains * response.misfit(response.predicted)


def test_channels_of_a_body_a_kind_and_an_axle_belong_together() -> None:
    train = load_system()
    rng = np.random.default_rng(1)
    values = (
        10 * rng.standard_normal((800, len(train.channels))) * np.array([channel.noise for channel in train.channels])
    )
    made = prepare(train, values, train.sample_rate).signals
    wired, names = Wiring(train, made), list(made.sensor_names)
    groups = wired.groups()
    bogie = tuple(i for i, name in enumerate(names) if name.startswith("bogie1"))
    assert Group(bogie) in groups and Group(tuple(range(len(names)))) in groups
    for axle in wired.axles():
        assert len(axle) == 2 and Group((), axle) in groups
        left, right = (str(made.support_names[j]) for j in axle)
        assert left[:-1] == right[:-1] and {left[-1], right[-1]} == {"l", "r"}
