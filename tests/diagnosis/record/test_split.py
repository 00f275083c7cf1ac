"""Where recordings are cut: at quiet moments, whatever happens at their ends."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.record.split import cut
from tests.diagnosis_cases import quarter_car, simulate


def prime_factors(number: int) -> set[int]:
    """The prime factors of a number."""
    factor = next((n for n in range(2, number + 1) if number % n == 0), 1)
    return {factor} | (prime_factors(number // factor) if factor < number else set())


@pytest.fixture(scope="module")
def signals() -> Signals:
    record = simulate(seconds=20.0, seed=40)
    return prepare(quarter_car(), record.values, record.sample_rate).signals


def test_parts_transform_quickly_and_keep_the_time_of_the_recording(signals: Signals) -> None:
    cut_off, split = cut(signals)
    first = round(cut_off.start * 100)
    assert all(max(prime_factors(length)) <= 11 for length in (split, cut_off.samples))
    assert 0 <= first <= 19 and signals.samples - 40 <= first + cut_off.samples <= signals.samples
    assert split / cut_off.samples == pytest.approx(0.7, abs=0.02)
    np.testing.assert_array_equal(cut_off.sensors, signals.sensors[first : first + cut_off.samples])
    assert cut_off.part(split, cut_off.samples).start == pytest.approx((first + split) / 100)


def test_blows_at_the_ends_and_at_the_split_are_cut_off(signals: Signals) -> None:
    _, split = cut(signals)
    sensors = signals.sensors.copy()
    for at in (0, split - 1, split, signals.samples - 1):
        sensors[max(at - 2, 0) : at + 3] += 50 * np.std(sensors)
    cut_off, moved = cut(replace(signals, sensors=sensors))
    first = round(cut_off.start * 100)
    assert first > 2 and first + cut_off.samples < signals.samples - 2
    assert abs(first + moved - split) > 2


def test_a_short_recording_is_only_shortened(signals: Signals) -> None:
    cut_off, split = cut(signals.part(0, 50))
    assert cut_off.samples == 50 and cut_off.start == 0.0 and split == 35
