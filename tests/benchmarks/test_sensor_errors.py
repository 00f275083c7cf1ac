"""Errors of sensors: every one changes its channel alone, and a clock all channels of a node."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.sensor_errors import CLOCK, KINDS, falsified, later
from sprung.model.system import load_system


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_changes_the_channels_it_names_and_no_others(kind: str) -> None:
    system, random = load_system(), np.random.default_rng(3)
    clean = np.cumsum(random.standard_normal((1000, len(system.channels))), axis=0)
    wrong = falsified(system, clean, kind, random)
    changed = {channel.name for i, channel in enumerate(system.channels) if np.any(wrong.values[:, i] != clean[:, i])}
    assert changed == wrong.channels and len(wrong.channels) == (4 if kind == CLOCK else 1)


def test_a_clock_is_right_in_the_middle_and_late_at_the_end() -> None:
    time, rate = np.arange(4000) / 100, 1e-4
    shown = later(np.sin(2 * np.pi * 12 * time)[:, None], rate)[:, 0]
    wanted = np.sin(2 * np.pi * 12 * (time - rate * (time - 20)))
    np.testing.assert_allclose(shown[50:-50], wanted[50:-50], atol=2e-3)
