"""Bounds of springs on moving supports: densities and derivatives against closed forms and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ive

from sprung.benchmarks import phase_information as information
from sprung.model.alps import phase


def test_one_vector_and_noise_have_the_score_of_rice() -> None:
    length, vector, noise = np.array([1.0, 1.2, 0.4]), np.array([1.1, 0.9, 0.5]), np.array([0.2, 0.3, 0.4])
    argument = 2 * length * vector / noise**2
    expected = 2 / noise**2 * (length * ive(1, argument) / ive(0, argument) - vector)
    found = information.scores(length, vector[:, None], noise)
    assert found[:, 0] == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_scores_of_sums_of_three_vectors_have_the_mean_zero() -> None:
    rng = np.random.default_rng(0)
    lengths, count = np.tile([1.0, 0.8, 0.7], (2000, 1)), 2000
    turned = lengths * np.exp(2j * np.pi * rng.uniform(size=lengths.shape))
    noise = 0.1 * (rng.standard_normal(count) + 1j * rng.standard_normal(count)) / np.sqrt(2)
    found = information.scores(np.abs(turned.sum(1) + noise), lengths, np.full(count, 0.1))
    assert (np.abs(found.mean(0)) < 4 * found.std(0) / count**0.5).all()


def test_transfers_are_those_of_the_experiment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phase, "NOISE", 0.0)
    ratio, supports, response = phase.draw(1, 3, np.random.default_rng(0))
    transfer, slope = information.transfers(ratio[0])
    np.testing.assert_allclose((transfer * supports[0]).sum(1), response[0])
    stiffer, _ = information.transfers(ratio[0] * np.array([1.0, 1.001, 1.0]))
    np.testing.assert_allclose((stiffer - transfer) / np.log(1.001), slope[:, :, 1], rtol=0.01, atol=1e-3)


def test_magnitudes_of_one_input_keep_the_spring_and_those_of_four_lose_it() -> None:
    bounds = {}
    for inputs in (1, 4):
        spectra, magnitudes = information.information(inputs, 4, np.random.default_rng(1))
        bounds[inputs] = information.bound(spectra, 0.3), information.bound(magnitudes, 0.3)
        assert bounds[inputs][0] < bounds[inputs][1]
    assert bounds[1][1] < 0.005 and bounds[4][0] < 0.01 and bounds[4][1] > 0.05
