"""Statistics of calibration errors against closed forms and against rigs that are drawn."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.investigation.measurements.outliers import (
    EstimatedError,
    is_outlier,
    relative_deviations,
    scatter_of,
    with_heavy_tails,
)
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import find_law
from sprung.model.signals import FloatArray

GAIN = find_law("sensor_gain")
SHEET = 0.015


def fit_of(errors: FloatArray, covariance: FloatArray) -> Any:
    """As much of a fit as is read: gains with errors (n,) in standard deviations of their data sheets."""
    terms = tuple(
        Term(GAIN, f"s{i}", (1 + SHEET * float(error),), scales=(SHEET,), known=(SHEET,))
        for i, error in enumerate(errors)
    )
    scaled = covariance * SHEET**2
    return SimpleNamespace(
        point=SimpleNamespace(terms=terms), covariance=scaled, place=lambda index: slice(index, index + 1)
    )


def outlier(errors: FloatArray, std: float = 1e-3) -> bool:
    fit = fit_of(errors, np.eye(len(errors)) * std**2)
    largest = int(np.argmax(np.abs(errors - np.median(errors))))
    return is_outlier(fit, fit.point.terms, fit.point.terms[largest].key, RULES.plausible)


def test_errors_no_further_apart_than_their_uncertainty_have_their_weighted_mean() -> None:
    errors = [EstimatedError(off, std) for off, std in ((0.1, 0.5), (-0.2, 1.0), (0.0, 2.0))]
    weight = np.array([4.0, 1.0, 0.25])
    mean, spread = scatter_of(errors)
    assert mean == pytest.approx(weight @ [0.1, -0.2, 0.0] / weight.sum())
    assert spread == pytest.approx(weight.sum() ** -0.5)


def test_how_far_errors_scatter_beyond_their_uncertainty_is_the_excess_of_their_variance() -> None:
    off, std = np.random.default_rng(3).normal(0, 2.0, 9), 0.7
    mean, spread = scatter_of([EstimatedError(float(one), std) for one in off])
    between = np.var(off, ddof=1) - std**2
    assert mean == pytest.approx(off.mean())
    assert spread == pytest.approx(np.sqrt(between + np.var(off, ddof=1) / 9))


def test_deviations_are_those_from_the_median_of_their_kind_less_what_all_share() -> None:
    covariance = 0.04 * np.eye(4) + 25.0  # a common factor that nothing determines
    fit = fit_of(np.array([5.0, 5.1, 4.9, 9.0]), covariance)
    away = relative_deviations(fit, fit.point.terms)
    assert [one.off for one in away.values()] == pytest.approx([-0.05, 0.05, -0.15, 3.95])
    assert [one.std for one in away.values()] == pytest.approx([0.2 * np.sqrt(3 / 4)] * 4)


def test_one_instrument_far_off_among_equal_ones_is_an_outlier() -> None:
    usual = np.array([0.2, -0.1, 0.05, -0.3, 0.1, 0.0, 0.25])
    assert outlier(np.append(usual, 6.0))
    assert not outlier(np.append(usual, 0.6))
    assert not outlier(np.array([4.0, -4.0, 6.0, -5.0, 5.5, 14.0]))  # all are off
    assert not outlier(np.array([0.0, 6.0]))  # which of the two?


def test_of_rigs_with_ordinary_instruments_hardly_one_has_an_outlier() -> None:
    rng = np.random.default_rng(7)
    rigs = rng.normal(size=(1500, 8))
    assert np.mean([outlier(rig) for rig in rigs]) < 0.03


def test_one_large_error_does_not_pull_the_others_along_a_factor_that_nothing_determines() -> None:
    """Differences between gains are known, what they share is not: one of six is eight data sheets off."""
    n, off = 6, 8.0
    differences = 1e4 * (np.eye(n) - 1 / n)
    covariance = np.asarray(np.linalg.inv(differences + np.eye(n)), dtype=np.float64)
    gaussian = covariance @ differences @ (off * np.eye(n)[0])  # the most likely errors under Gaussian priors
    fit = fit_of(gaussian, covariance)
    found = np.array([(term.parameters[0] - 1) / SHEET for term in with_heavy_tails(fit, range(n))])
    assert np.abs(gaussian[1:]).min() > 1.3  # a sixth of it
    assert np.abs(found[1:]).max() < 0.3 and found[0] == pytest.approx(off, abs=0.3)
    np.testing.assert_allclose(np.diff(found), np.diff(gaussian), atol=1e-6)  # what was measured stays


def test_errors_that_the_recording_determines_stay_as_they_are() -> None:
    errors, covariance = np.array([5.0, 0.1, -0.2]), np.eye(3) * 0.01
    found = with_heavy_tails(fit_of(errors, covariance), range(3))
    assert [(term.parameters[0] - 1) / SHEET for term in found] == pytest.approx(errors)
