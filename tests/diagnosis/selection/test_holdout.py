"""The held-out part: free runs of a model whose values are true, and how often a comparison refutes what is true."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.selection.holdout import HeldOut, HeldOutComparison
from tests.diagnosis_cases import quarter_car, simulate, true_log_ratios


def comparisons(apart: float, second_is_true: bool, number: int = 4000) -> list[HeldOutComparison]:
    """Of two predictions that are `apart` in units of noise, one of them true."""
    random, bins = np.random.default_rng(1), 50
    difference = np.full(bins, apart / np.sqrt(bins))
    noise = random.standard_normal((number, bins))
    first, second = (noise + difference, noise) if second_is_true else (noise, noise + difference)
    gains = np.sum(first**2, axis=1) - np.sum(second**2, axis=1)
    return [HeldOutComparison(float(gain), float(gain), apart, 1.0) for gain in gains]


@pytest.mark.parametrize("apart", [0.5, 3.0, 8.0, 30.0])
def test_what_is_true_is_hardly_ever_refuted(apart: float) -> None:
    """By a standard normal three deviations below its mean."""
    assert np.mean([one.refuted for one in comparisons(apart, second_is_true=True)]) < 4e-3


@pytest.mark.parametrize("apart", [6.0, 8.0, 30.0])
def test_what_is_false_and_far_enough_away_is_refuted(apart: float) -> None:
    assert np.mean([one.refuted for one in comparisons(apart, second_is_true=False)]) > 0.99


def test_what_is_closer_to_every_sensor_is_not_refuted_by_slow_errors_far_from_noise() -> None:
    far = HeldOutComparison(gain=-28250.0, evidence=-28250.0, apart=332.0, scatter=1.4)
    assert far.refuted and not replace(far, closer=True).refuted


def test_what_predicts_nearly_the_same_is_hardly_ever_refuted() -> None:
    assert np.mean([one.refuted for one in comparisons(0.05, second_is_true=False)]) < 4e-3


@pytest.fixture(scope="module")
def fitted() -> tuple[HeldOut, Fit]:
    system = quarter_car()
    signals = prepare(system, simulate(seconds=20.0, seed=5).values, 100.0).signals
    noise, split = declared_noise(system, signals), 1400
    problem, fit = baseline(system, signals, noise, split)
    return HeldOut(system, signals, problem.noise, split), fit


def test_a_model_with_true_values_errs_by_the_noise_alone(fitted: tuple[HeldOut, Fit]) -> None:
    held, fit = fitted
    true = replace(fit.point, theta=true_log_ratios(held.system))
    run = held.run(true)
    assert run.measured.shape == run.simulated.shape == (held.signals.samples - held.split, 4)
    error = np.sqrt(np.mean((run.measured - run.simulated) ** 2, axis=0))
    np.testing.assert_allclose(error, held.noise_rms(fit, held.noise), rtol=0.15)


def test_other_values_are_refuted_and_near_ones_are_not(fitted: tuple[HeldOut, Fit]) -> None:
    held, fit = fitted
    true = replace(fit, point=replace(fit.point, theta=true_log_ratios(held.system)))
    wrong = replace(fit, point=replace(fit.point, theta=true.point.theta + np.array([0.05, 0.0, 0.0, 0.0])))
    assert held.compare(true, wrong).refuted
    assert not held.compare(wrong, true).refuted
    assert not held.compare(true, fit).refuted
    assert held.compare(wrong, true).closer and not held.compare(true, wrong).closer
    assert not held.compare(true, fit).closer


def test_a_held_out_part_that_rests_decides_nothing(fitted: tuple[HeldOut, Fit]) -> None:
    held, _ = fitted
    sensors = held.signals.sensors.copy()
    sensors[held.split :] *= 0.01
    assert replace(held, signals=replace(held.signals, sensors=sensors)).still
    assert not held.still
