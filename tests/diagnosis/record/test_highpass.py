"""All signals behind one filter where supports are known by their acceleration alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.highpass import carries_everything, passed, slowest_mode
from sprung.model.diagnosis.rules import RULES
from sprung.model.system import System, load_system
from tests.diagnosis_cases import quarter_car, simulate


@pytest.fixture(scope="module")
def system() -> System:
    return quarter_car()


def test_bodies_on_one_support_drift_with_it_unless_a_sensor_is_absolute() -> None:
    car = quarter_car()
    (support,) = car.file.inputs
    assert carries_everything(car, support)
    several = load_system()
    assert not carries_everything(several, next(iter(several.file.inputs)))


def test_the_slowest_mode_is_that_of_the_closed_form(system: System) -> None:
    """Rigid bodies that nothing holds do not count."""
    A, *_ = system.mechanics.matrices()
    own = np.abs(np.linalg.eigvals(A)).min() / (2 * np.pi)
    assert slowest_mode(system, RULES.record.held) == pytest.approx(own, rel=1e-6)
    assert slowest_mode(system, own * 1.01) > 1.01 * own


def test_signals_that_are_not_integrated_stay_as_they_are(system: System) -> None:
    signals = prepare(system, simulate(seconds=5).values, 100.0).signals
    assert passed(system, signals, RULES.record) == (signals, 0.0)


def test_a_drift_goes_from_all_signals_and_fast_motion_stays() -> None:
    """Supports of two bogies known by their accelerations: a metre of drift, a millimetre of track."""
    system = load_system()
    rng, T = np.random.default_rng(5), 6000
    signals = prepare(system, rng.standard_normal((T, len(system.channels))), 100.0).signals
    time = np.arange(T) / 100
    fast = 1e-3 * np.sin(2 * np.pi * 8.0 * time)[:, None] * np.ones(signals.displacement.shape[1])
    every = np.ones(signals.displacement.shape[1], dtype=bool)
    drifting = replace(
        signals,
        displacement=fast + (time[:, None] / 60) ** 2,
        velocity=np.full_like(signals.velocity, np.nan),
        integrated=every,
        accelerated=every,
    )
    found, cutoff = passed(system, drifting, RULES.record)
    assert 0 < cutoff < slowest_mode(system, RULES.record.held) and found.cutoff == cutoff
    cut = round(RULES.record.settled / cutoff * 100)
    kept = fast[cut : T - cut]
    assert found.displacement.shape == kept.shape
    assert np.abs(found.displacement - kept)[cut:-cut].max() < 0.05 * np.abs(kept).max()
    assert np.isnan(found.velocity).all()
