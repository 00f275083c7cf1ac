"""What is put into a recording leads the candidates of its group, at its place and with its size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.elements import element_candidates
from sprung.model.diagnosis.screening.harmonics import harmonic_candidates
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.diagnosis.screening.sensors import measurement_candidates
from sprung.model.laws import CATALOGUE, CLOCK_LEAD, SupportLaw, find_law
from tests.diagnosis_cases import MadeRecord, problem_of, simulate, true_log_ratios

ROAD, RATE, CAR_A, CAR_B, BOGIE_A, BOGIE_B = range(6)  # columns


def leading(record: MadeRecord, group: Callable[..., Any]) -> Candidate:
    """The candidate of a group with the highest score beside the true springs and dampers."""
    problem = problem_of(record)
    fit = optimise(problem, Point(true_log_ratios(problem.system), (), np.zeros(4)), iterations=3)
    found = [candidate for candidate, _ in group(Projector(problem, fit, True), CATALOGUE)]
    return max(found, key=lambda candidate: candidate.score)


@pytest.mark.parametrize(
    ("law", "names"),
    [
        (
            lambda d, v: 250.0 * np.tanh(v / 0.01),
            {"coulomb_friction", "stribeck", "dahl", "lugre", "bouc_wen", "damper_blowoff"},
        ),
        (lambda d, v: 3e9 * d**3, {"cubic_stiffness", "progressive_stop", "bump_stop", "gas_spring"}),
    ],
    ids=["friction", "cubic spring"],
)
def test_a_law_of_an_element_leads_there(law: Callable[[float, float], float], names: set[str]) -> None:
    first = leading(simulate(law, seconds=12, seed=3), element_candidates)
    assert first.location == "secondary" and (first.effect in names or not first.term.law.named)
    assert first.score > 50


@pytest.mark.parametrize(
    ("column", "place", "effect"),
    [
        (CAR_B, "car_b", "sensor_gain"),
        (BOGIE_A, "bogie_a", "sensor_gain"),
        (BOGIE_B, "bogie_b", "sensor_lag"),
        (ROAD, "wheel.displacement", "sensor_gain"),  # which the velocity beside it contradicts
        (RATE, "wheel.velocity", "sensor_gain"),
    ],
)
def test_a_fault_of_a_channel_leads_at_that_channel(column: int, place: str, effect: str) -> None:
    record = simulate(seconds=12, seed=4)
    if effect == "sensor_gain":
        record.values[:, column] *= 1.05
    else:
        record.values[:, column] = np.interp(
            np.arange(len(record.values)) - 0.3, np.arange(len(record.values)), record.values[:, column]
        )
    first = leading(record, measurement_candidates)
    assert (first.location, first.effect) == (place, effect) and first.score > 50


def test_nothing_leads_far_in_a_clean_recording() -> None:
    record = simulate(seconds=12, seed=5)
    for group in (element_candidates, measurement_candidates):
        assert leading(record, group).score < 30


def test_harmonics_that_the_support_does_not_show_lead_with_their_frequency() -> None:
    """The road that acts is the measured one and a wheel's flat, 6.3 times a second."""
    flat = find_law("wheel_flat")
    assert isinstance(flat, SupportLaw)
    record = simulate(seconds=12, seed=6)
    time = CLOCK_LEAD + np.arange(len(record.values)) / 100
    displacement, rate = flat.movement(time, (3e-4, 6.3, 0.2), 42.0)
    record.values[:, ROAD] -= displacement
    record.values[:, RATE] -= rate
    first = leading(record, harmonic_candidates)
    assert first.location == "wheel" and first.score > 50
    frequency = first.term.law.frequency
    assert frequency is not None
    ratio = first.term.parameters[frequency] / 6.3
    whole = max(ratio, 1 / ratio)
    assert whole == pytest.approx(round(whole), rel=0.01)  # or a multiple, or a part of it
