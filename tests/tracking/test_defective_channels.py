"""A gain that was far beyond its data sheet from the first window on is told as it is, not held by its tolerance."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Deviating
from sprung.model.tracking import deviation_record
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking.deviation_model import model_of
from sprung.model.tracking.settings import TrackerSettings

SHEET, CHANNELS = 0.015, 8
GAINS = [Deviation(f"c{i}", "gain", SHEET, i) for i in range(CHANNELS)]
SECOND = 1_000_000_000


def followed(gain: float, seed: int, windows: int = 80) -> tuple[np.ndarray, np.ndarray, float]:
    """Errors of the told gains (C,), their stated deviations, and the error of the believed gain.

    Channel 2 reads 1 + `gain`, the others are within half of their tolerance.

    A window tells a gain to 6 %, all of them together to half of a tolerance.
    """
    model, settings, rng = model_of(GAINS), TrackerSettings(), np.random.default_rng(seed)
    record, belief = deviation_record.start(1, model), kalman.prior(1, settings.prior, settings.process, model.prior)
    information = (np.eye(CHANNELS) - 1 / CHANNELS) / 0.06**2
    truth = gain * (np.arange(CHANNELS) == 2) + 0.5 * SHEET * rng.standard_normal(CHANNELS) * (np.arange(CHANNELS) != 2)
    root = np.linalg.cholesky(information + 1e-9 * np.eye(CHANNELS))
    given, cross = np.array([[0.01**2]]), np.zeros((1, CHANNELS))
    for k in range(windows):
        score = information @ truth + root @ rng.standard_normal(CHANNELS)
        found = Deviating(np.zeros(CHANNELS), given, cross, information, score, 300.0)
        record, belief, _, _ = dev.update(record, model, belief, found, 1.0, k * SECOND)
    held = belief.mean[-CHANNELS:] - truth
    value, covariance = dev.without_data_sheets(record, model, belief)
    std = model.relative_std(covariance)
    off = value - model.common_value(value) - (truth - np.median(truth))
    return off, std, (held - np.median(held))[2]


@pytest.mark.parametrize("gain", [0.05, -0.1])
def test_a_gain_far_beyond_its_data_sheet_is_told_within_what_is_stated(gain: float) -> None:
    found = [followed(gain, seed) for seed in range(12)]
    off = np.array([error[2] / std[2] for error, std, _ in found])
    assert np.abs(off).max() < 3.0
    assert abs(off.mean()) < 1.0
    if abs(gain) < 0.1:  # a larger one is found sooner, and hardly held
        assert abs(np.mean([error[2] for error, *_ in found])) < 0.5 * abs(np.mean([held for *_, held in found]))


def test_channels_within_their_data_sheets_keep_them() -> None:
    found = [followed(0.01, seed) for seed in range(12)]
    score = np.array([error / std for error, std, _ in found])
    assert np.abs(score).max() < 3.5
    assert np.mean(score**2) < 1.3
