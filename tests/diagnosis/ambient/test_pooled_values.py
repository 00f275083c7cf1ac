"""Means over windows without measured inputs, and which parameters vary."""

import numpy as np
import pytest

from sprung.model.diagnosis.ambient.judgement import pool
from sprung.model.diagnosis.ambient.windows import Powers, WindowResult
from sprung.model.diagnosis.rules import RULES
from sprung.model.signals import FloatArray

NOTHING = Powers(*[np.zeros((0, 0))] * 5)


def windows(log_ratio: FloatArray, deviation: float | FloatArray, overlap: float = 0.0) -> list[WindowResult]:
    """Of 60 s each, with log-ratios (W, P)."""
    P = log_ratio.shape[1]
    covariance = np.diag(np.broadcast_to(deviation, P) ** 2)
    starts = 60.0 * (1 - overlap) * np.arange(len(log_ratio))
    return [WindowResult(s, s + 60, one, covariance, True, NOTHING) for s, one in zip(starts, log_ratio, strict=True)]


def test_constant_parameters_hardly_ever_vary_and_their_mean_is_as_exact_as_it_says() -> None:
    random, scores, found = np.random.default_rng(1), [], 0
    for _ in range(300):
        pooled = pool(windows(0.1 + 0.02 * random.standard_normal((8, 3)), 0.02))
        found += int(pooled.varying.sum())
        scores.append((pooled.log_ratio - 0.1) / pooled.deviation)
    assert found <= 1  # one in 10 000 by chance
    assert np.std(scores) == pytest.approx(1.0, abs=0.15)


def test_a_parameter_that_falls_on_the_way_varies_and_the_others_do_not() -> None:
    random = np.random.default_rng(2)
    values = 0.01 * random.standard_normal((10, 3))
    values[5:, 1] -= 0.3
    pooled = pool(windows(values, 0.01))
    assert pooled.varying.tolist() == [False, True, False]
    assert pooled.chance[1] < 1e-30


def test_a_change_that_is_significant_but_small_is_no_variation() -> None:
    values = np.zeros((10, 1))
    values[5:] += 0.9 * RULES.ambient.varies
    pooled = pool(windows(values, 1e-4))
    assert pooled.chance[0] < RULES.ambient.alpha and not pooled.varying[0]


def test_windows_that_overlap_are_no_more_exact_than_those_that_do_not() -> None:
    apart, half = pool(windows(np.zeros((5, 1)), 0.02)), pool(windows(np.zeros((9, 1)), 0.02, overlap=0.5))
    assert half.deviation[0] == pytest.approx(apart.deviation[0])


def test_an_undetermined_parameter_keeps_its_prior() -> None:
    pooled = pool(windows(np.full((5, 2), 0.4), np.array([0.02, 0.5])))
    assert pooled.log_ratio.tolist() == pytest.approx([0.4, 0.0])
    assert pooled.deviation[1] == 1.0
