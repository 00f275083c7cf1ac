"""Gains and delays that are taken back from windows, and the steps that score and information ask for."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.fault_isolation.corrections import MARGIN, Corrections
from sprung.model.identification.fault_isolation.steps import EVIDENT, DeviationSteps
from sprung.model.identification.measurements.deviations import clock_groups, deviations
from sprung.model.signals import FloatArray, MeasurementFault
from sprung.model.system import System, load_system

SAMPLES = 100


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def corrections(system: System) -> Corrections:
    return Corrections(system, SAMPLES, deviations(system))


@pytest.fixture(scope="module")
def steps(system: System, corrections: Corrections) -> DeviationSteps:
    return DeviationSteps(system, corrections)


def sines(channels: int, late: FloatArray) -> FloatArray:
    """One window (1, T, C) of 3 Hz, each channel late by so many seconds."""
    time = np.arange(SAMPLES)[:, None] / 100
    return np.asarray(np.sin(2 * np.pi * 3 * (time - late) + np.arange(channels)))[None]


def test_what_is_corrected_is_the_window_before_its_gain_and_delay(corrections: Corrections) -> None:
    C, names = corrections.channels, corrections.names
    known = (MeasurementFault(names[3], "gain", 1.25), MeasurementFault(f"{names[5]}|{names[6]}", "delay", 0.023))
    (point,) = corrections.points([known], 1)
    late = np.zeros(C)
    late[[5, 6]] = 0.023
    wrong, right = sines(C, late), sines(C, np.zeros(C))
    wrong[:, :, 3] *= 1.25
    (edge,) = corrections.margin(point[None])
    assert edge == 3 + MARGIN  # 2.3 samples
    found = corrections.corrected(wrong, point[None])
    assert np.abs(found - right)[:, edge:-edge].max() < 1e-3 < np.abs(wrong - right)[:, edge:-edge].max()
    assert corrections.margin(np.zeros((1, len(point))))[0] == 0


def test_gains_multiply_and_delays_add(corrections: Corrections) -> None:
    C = corrections.channels
    first, second = np.zeros((2, len(corrections.deviations)))
    first[0], second[0], first[C], second[C] = 0.1, 0.2, 0.01, 0.02
    moved = corrections.moved(first, second)
    assert moved[0] == pytest.approx(0.32) and moved[C] == pytest.approx(0.03)


def test_a_channel_without_a_gain_and_a_delay_of_most_of_a_window_are_not_believed(corrections: Corrections) -> None:
    C = corrections.channels
    point = np.zeros(len(corrections.deviations))
    assert corrections.credible(point)
    for at, value in ((0, -0.95), (C, 1.01 * corrections.longest)):
        wrong = point.copy()
        wrong[at] = value
        assert not corrections.credible(wrong)


@pytest.mark.parametrize("size", [0.3, -0.02])
def test_the_strongest_step_is_the_deviation_that_made_the_score(steps: DeviationSteps, size: float) -> None:
    """Of a quadratic log-likelihood the maximum and its height are known."""
    H = len(steps.std)
    information = np.diag(np.linspace(1e3, 2e3, H))
    truth = np.zeros(H)
    truth[7] = size
    found, evidence = steps.strongest(information @ truth, information)
    assert np.allclose(found, truth) and evidence == pytest.approx(truth @ information @ truth / 2)
    assert steps.apart(information @ truth, information) == (evidence > EVIDENT)


def test_channels_of_one_clock_that_are_late_together_are_one_step(system: System, steps: DeviationSteps) -> None:
    """Each alone explains less than all of them."""
    groups = clock_groups(system)
    group = np.flatnonzero(groups == np.argmax(np.bincount(groups)))
    H, C = len(steps.std), len(groups)
    information = 1e9 * np.eye(H)
    truth = np.zeros(H)
    truth[C + group] = 5e-3
    found, _ = steps.strongest(information @ truth, information)
    assert len(group) > 1 and np.allclose(found, truth)
    assert np.allclose(steps.of_clocks(information @ truth, information), truth, rtol=1e-2, atol=1e-6)


def test_the_most_likely_deviations_lie_between_those_of_the_window_and_none(steps: DeviationSteps) -> None:
    """With independent deviations each is s S^2 / (1 + i S^2), by hand."""
    score, i = np.linspace(-2.0, 3.0, len(steps.std)), np.linspace(0.0, 5.0, len(steps.std)) / steps.std**2
    found = steps.most_likely(score, np.diag(i))
    assert np.allclose(found, score * steps.std**2 / (1 + i * steps.std**2))
