"""What errors that are not noise add to the uncertainty of values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.investigation.judgement.misfit_covariance import _of_stretches, misfit_covariance
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from tests.diagnosis_cases import quarter_car, simulate


def fitted(cubic: float) -> tuple[Problem, Fit]:
    """The linear quarter car along a recording of one with a cubic spring, N/m^3."""
    system = quarter_car()
    signals = prepare(system, simulate(lambda d, v: cubic * d**3, seconds=5).values, 100.0).signals
    return baseline(system, signals, declared_noise(system, signals), signals.samples)


@pytest.fixture(scope="module")
def exact() -> tuple[Problem, Fit]:
    return fitted(0.0)


def test_errors_that_are_correlated_within_a_stretch_add_up_and_others_do_not() -> None:
    """Of a constant error g in every bin a stretch of b bins has (b g)^2, of signs that alternate nothing."""
    bins, count = 120, 6
    whitener: Any = SimpleNamespace(factor=np.zeros((bins, 1, 1)))

    def of(residual: np.ndarray) -> float:
        fit: Any = SimpleNamespace(jacobian=np.ones((2 * bins, 1)), residual=residual, whitener=whitener)
        return float(_of_stretches(fit, count)[0, 0])

    assert of(np.ones(2 * bins)) == pytest.approx(count * (2 * bins / count) ** 2)
    assert of(np.tile([1.0, -1.0], bins)) == 0.0


def test_an_exact_model_adds_little_and_a_wrong_one_most_of_what_it_errs(exact: tuple[Problem, Fit]) -> None:
    problem, fit = exact
    own = np.sqrt(np.diag(fit.covariance))
    little = np.sqrt(np.maximum(np.diag(misfit_covariance(problem, fit)), 0.0))
    wrong, spoilt = fitted(3e9)
    much = np.sqrt(np.diag(misfit_covariance(wrong, spoilt)))
    moved = np.abs(spoilt.point.theta - fit.point.theta)
    assert np.all(little < 3 * own) and np.all(much > little)
    assert np.max(moved / own) > 100  # what chance alone would call impossible
    assert np.max(moved / np.hypot(own, much)) < 0.1 * np.max(moved / own)


def test_what_is_added_is_a_covariance(exact: tuple[Problem, Fit]) -> None:
    problem, fit = exact
    added = misfit_covariance(problem, fit)
    assert added.shape == fit.covariance.shape and np.allclose(added, added.T)
    total = fit.covariance + added
    scale = np.sqrt(np.diag(total))
    assert np.linalg.eigvalsh(total / np.outer(scale, scale)).min() > -1e-9
