"""Channels of a support that contradict each other: the wrong one leads, with the error that was put in."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.diagnosis.screening.supports import support_candidates
from sprung.model.laws import CATALOGUE, SensorLaw
from tests.diagnosis_cases import MadeRecord, problem_of, simulate

LAWS = [law for law in CATALOGUE if isinstance(law, SensorLaw) and "support" in law.at]
DISPLACEMENT, VELOCITY = 0, 1  # columns of the simulated wheel


def leading(record: MadeRecord) -> list[Candidate]:
    """Faults of the wheel's channels, highest score first."""
    problem = problem_of(record)
    fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    found = [one for one, _ in support_candidates(Projector(problem, fit), LAWS)]
    return sorted(found, key=lambda one: -one.score)


@pytest.mark.parametrize(("column", "channel"), [(DISPLACEMENT, "wheel.displacement"), (VELOCITY, "wheel.velocity")])
def test_a_gain_of_one_of_two_measurements_is_that_channels(column: int, channel: str) -> None:
    record = simulate(seed=21)
    record.values[:, column] *= 1.03
    first = leading(record)[0]
    assert (first.location, first.effect) == (channel, "sensor_gain")
    assert 1.01 < first.term.parameters[0] < 1.04  # one step, beside motions that are fitted to both channels


def test_a_late_channel_is_named_with_its_lag() -> None:
    record = simulate(seed=22)
    late = record.values.copy()
    late[1:, VELOCITY] = record.values[:-1, VELOCITY]
    first = leading(MadeRecord(late[1:]))[0]
    assert first.location == "wheel.velocity" and first.term.law.delays
    assert first.term.parameters[0] == pytest.approx(0.01, rel=0.1)


def test_an_offset_of_a_velocity_is_seen_where_the_displacement_stays() -> None:
    record = simulate(seed=23)
    record.values[:, VELOCITY] += 2e-3
    first = leading(record)[0]
    assert (first.location, first.effect) == ("wheel.velocity", "sensor_bias")
    assert first.term.parameters[0] == pytest.approx(2e-3, rel=0.1)


def test_right_channels_contradict_each_other_by_no_more_than_noise() -> None:
    assert leading(simulate(seed=24))[0].score < 20.0
