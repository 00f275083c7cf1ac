"""Months of service in estimate space: estimates are drawn as they state, and a hidden fault is found and named."""

import numpy as np
import pytest

from sprung.benchmarks import day
from sprung.model.identification.deviations import deviations
from sprung.model.system import load_system


@pytest.fixture(scope="module")
def windows():
    return day.library(load_system(), 6, 3)


def test_estimates_scatter_about_the_truth_as_they_state(windows):
    system, rng = load_system(), np.random.default_rng(1)
    truth, off = rng.normal(0, 0.1, 24), np.zeros(len(deviations(system)))
    off[-1] = 0.2
    drawn = [day.drawn(rng, windows[0], truth, off) for _ in range(400)]
    errors = np.array([e.log_ratio for e in drawn]) - truth
    scores = errors / np.sqrt(np.diag(drawn[0].covariance))
    assert np.sqrt(np.mean(scores**2)) == pytest.approx(1.0, abs=0.1)
    loads = np.array([e.deviating.point[-1] for e in drawn]) - 0.2
    assert abs(loads.mean()) < 4 * loads.std() / np.sqrt(400)
    gains = [e.deviating.information @ (off - e.deviating.point) for e in drawn]
    slopes = np.array([e.deviating.score for e in drawn]) - gains  # at the true deviations: no slope on average
    spread = np.sqrt(np.diag(drawn[0].deviating.information) / 400)
    assert np.all(np.abs(slopes.mean(axis=0)) < 5 * spread + 1e-6)


def test_a_damper_that_loses_a_seventh_is_found_beside_weather_and_loads(windows, monkeypatch):
    monkeypatch.setattr(day, "SETTLED_DAYS", 0.5)
    life = day.live(load_system(), windows, 1.2, 5, measured=True, fault="secondary_1r.damping")
    assert life.isolated or life.found_after is None  # another alarm never comes first
    assert life.strangers == []
