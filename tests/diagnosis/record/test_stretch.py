"""Standstill is left out, and of long recordings the stretch that moves most is used."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.stretch import liveliest, standstill
from sprung.model.diagnosis.rules import RecordRules
from tests.diagnosis_cases import quarter_car, simulate


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
