"""Memories without a rate of their own, from reversal to reversal, against the same stepped sample by sample."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sprung.model.laws.paths import presliding_path, recurrence, stop_path
from sprung.model.laws.reversals import Stretches

T = np.arange(1500) / 200
MOTIONS = {
    "sines": 0.012 * np.sin(4.4 * T) + 0.004 * np.sin(12 * T),
    "noise": np.random.default_rng(3).normal(0, 5e-3, 1500),
    "steps": np.repeat(np.random.default_rng(4).normal(0, 1e-2, 150), 10),
    "one way": np.linspace(0, 0.03, 50),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_stretches_are_the_whole_motion(motion: str) -> None:
    d = MOTIONS[motion]
    runs = Stretches.of(d)
    assert np.all(runs.lengths >= 0) and len(runs.way) == len(d) - 1
    np.testing.assert_allclose(np.sum(runs.signs * runs.lengths), d[-1] - d[0], atol=1e-15)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("corner", [0.0, 1e-3])
def test_a_slider_is_bent_as_if_stepped(motion: str, corner: float) -> None:
    d, reach = MOTIONS[motion], 3e-3
    u, stepped = 0.0, [0.0]
    for way in np.diff(d):
        sign, fine = math.copysign(1.0, way), 1 if corner == 0 else 400
        for _ in range(fine):
            step, ahead = abs(way) / fine, sign * u
            share = 1.0 if corner == 0 else min(1.0, (reach - ahead) / corner)
            u = sign * min(reach, ahead + step * share)
        stepped.append(u)
    np.testing.assert_allclose(stop_path(d, reach, corner), stepped, atol=1e-12 if corner == 0 else 2e-5)


@pytest.mark.parametrize("motion", MOTIONS)
def test_dahls_slider_is_bent_as_if_stepped(motion: str) -> None:
    d, reach = MOTIONS[motion], 3e-3
    z, stepped = 0.0, [0.0]
    for way in np.diff(d):
        keep = math.exp(-abs(way) / reach)
        z = keep * z + math.copysign(1 - keep, way)
        stepped.append(z)
    np.testing.assert_allclose(presliding_path(d, reach), stepped, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 1000])
def test_a_recurrence_is_that_of_its_steps(count: int) -> None:
    random = np.random.default_rng(count)
    keep, add = np.exp(-random.exponential(0.3, count)), random.standard_normal(count)
    found, x = [], 0.0
    for a, b in zip(keep, add, strict=True):
        x = a * x + b
        found.append(x)
    np.testing.assert_allclose(recurrence(keep, add), found, rtol=1e-12, atol=1e-12)
