"""Standstill is left out, and of long recordings the stretch that moves most is used."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.api import TooLittleError, diagnose
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.stretch import at_rest, liveliest, standstill
from sprung.model.diagnosis.rules import RecordRules
from tests.diagnosis_cases import MadeRecord, quarter_car, simulate


def test_standstill_is_where_most_channels_rest_together() -> None:
    moving = np.random.default_rng(1).normal(size=(1000, 4))
    moving[300:500] = moving[300]
    moving[600:900, 0] = 1.0  # one frozen sensor is no standstill
    still = standstill(moving, 100, 0.5)
    assert still[310:490].all() and not still[:299].any() and not still[502:].any()


def test_a_stop_is_left_out_and_no_channel_counts_as_stuck() -> None:
    record = simulate(seconds=20)
    values = record.values.copy()
    values[:400] = values[0]
    prepared = prepare(quarter_car(), values, record.sample_rate)
    assert prepared.stuck == ()
    assert prepared.signals.samples >= len(values) - 410
    assert any("standstill" in note for note in prepared.notes)


def test_a_rest_is_where_all_channels_show_their_noise_alone() -> None:
    rng, noise = np.random.default_rng(3), np.array([1e-5, 4e-3])
    values = 0.3 + noise * rng.normal(size=(4000, 2))
    values[:1000] += 50 * noise * np.sin(np.arange(1000) / 20)[:, None]
    values[2200:2500, 1] += 20 * noise[1] * rng.normal(size=300)  # somebody walks in a standing car
    rest = at_rest(values, 2 * noise, 500)
    assert rest[1050:2150].all() and rest[2550:].all() and not rest[:900].any() and not rest[2300:2400].any()
    assert not at_rest(values, 2 * noise, 3000).any()


def test_a_vehicle_that_ran_and_stands_is_diagnosed_on_its_ride() -> None:
    """Noise does not repeat: what a standing vehicle shows had been simulated, and nothing fitted."""
    record = simulate(seconds=36, seed=5)
    rng = np.random.default_rng(6)
    noise = np.array([channel.noise for channel in quarter_car().channels])
    values = record.values.copy()
    values[1740:] = values[1740] * [1, 0, 0, 0, 0, 0] + noise * rng.normal(size=(1800, 6))
    report = diagnose(quarter_car(), MadeRecord(values))
    assert report.verdict == "consistent" and report.findings == ()
    assert any(note.startswith("standstill of 18") for note in report.advice), report.advice
    with pytest.raises(TooLittleError, match="too still to decide anything"):
        diagnose(quarter_car(), MadeRecord(values[1840:]))


def test_the_liveliest_stretch_of_a_long_recording_is_used_and_said() -> None:
    record = simulate(seconds=20)
    values = record.values.copy()
    values[:1000] *= 0.2
    prepared = prepare(quarter_car(), values, record.sample_rate, RecordRules(longest=800))
    assert prepared.signals.samples == 800 and prepared.signals.start >= 9.9
    assert "were diagnosed, where the sensors move most" in prepared.used


def test_a_single_shock_does_not_choose_the_stretch() -> None:
    series = np.random.default_rng(2).normal(size=(3000, 1))
    series[2000:] *= 2
    series[100] = 500.0
    assert liveliest(series, 800)[0] >= 1900
