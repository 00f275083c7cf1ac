"""Changes of a set-up estimated from a residual, with what springs and dampers explain taken out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.investigation.configuration.scores import SetupScores
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from tests.diagnosis_cases import quarter_car, simulate


@pytest.fixture(scope="module")
def scores() -> SetupScores:
    system = quarter_car()
    signals = prepare(system, simulate(seconds=5).values, 100.0).signals
    problem, fit = baseline(system, signals, declared_noise(system, signals), signals.samples)
    return SetupScores(problem, fit)


def test_a_change_that_is_in_the_residual_is_estimated_with_its_size(scores: SetupScores) -> None:
    """A sensor's gain: what it shows, once more."""
    change = np.zeros_like(scores.predicted)
    change[:, 1] = scores.predicted[:, 1]
    column = scores._projected(scores._flat(change))
    before, scores.residual = scores.residual, scores.residual + 0.3 * column
    found, other = scores.of(change), scores.of(2 * change)
    scores.residual = before
    assert found.amount == pytest.approx(0.3, abs=4 * found.std) and found.std < 0.02
    assert other.amount == pytest.approx(found.amount / 2) and other.misfit == pytest.approx(found.misfit)
    assert found.misfit == pytest.approx(scores.of(change).misfit)  # all of it is explained


def test_what_a_spring_or_damper_changes_is_no_change_of_the_set_up(scores: SetupScores) -> None:
    for one in np.eye(len(scores.theta)):
        change = (scores._predict(scores.problem.system, scores.theta + 1e-3 * one) - scores.predicted) / 1e-3
        found = scores.of(change)
        assert found.amount == 0.0 and found.std == np.inf


def test_the_same_system_is_no_change(scores: SetupScores) -> None:
    assert scores.of_system(scores.problem.system).std == np.inf


def test_fewer_bins_estimate_the_same_less_exactly(scores: SetupScores) -> None:
    problem = scores.problem
    assert scores.band.stop > 100
    change = np.zeros_like(scores.predicted)
    change[:, 0] = scores.predicted[:, 0]
    whole = scores.of(change)
    spectrum = problem.part.sensors.copy()
    spectrum[scores.band] -= scores.predicted
    fit: Any = SimpleNamespace(point=SimpleNamespace(theta=scores.theta), spectrum=spectrum)
    few = SetupScores(problem, fit, most=60)
    thin = np.zeros_like(few.predicted)
    thin[:, 0] = few.predicted[:, 0]
    part = few.of(thin)
    assert len(few.predicted) < len(scores.predicted) / 2 and part.std > whole.std
    assert abs(part.amount - whole.amount) < 4 * part.std
