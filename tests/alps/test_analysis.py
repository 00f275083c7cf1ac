"""Kernels of Fig. 3, the experiment on phases, and the figures' definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sprung.model.alps import kernels, metrics, pendulum, phase, two_body


def test_the_tangent_kernel_is_that_of_a_wide_network() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((4, 5))
    exact = kernels.tangent_kernel(features, layers=1)
    width = 200_000  # f(x) = sqrt(2 / n) sum_i v_i relu(w_i x): its NTK is an average over n hidden units
    w, v = rng.standard_normal((width, 5)), rng.standard_normal(width)
    hidden = features @ w.T
    active = (hidden > 0).astype(float)
    by_v = 2 / width * np.maximum(hidden, 0) @ np.maximum(hidden, 0).T
    by_w = 2 / width * ((active * v) @ (active * v).T) * (features @ features.T)
    np.testing.assert_allclose(by_v + by_w, exact, rtol=0.03, atol=0.03 * np.abs(exact).max())


def test_the_dft_alone_leaves_the_kernel_as_it_is() -> None:
    np.testing.assert_allclose(kernels.view("k_DFT").kernel, kernels.view("none").kernel, atol=1e-9)


def test_magnitudes_of_shifted_windows_are_nearly_alike() -> None:
    assert kernels.view("k_MAG").row.min() > 0.8 > kernels.view("none").row.min()


def test_the_signal_has_the_papers_six_lines() -> None:
    spectrum = np.abs(np.fft.rfft(kernels.six_sines())) / 100
    for frequency, amplitude in zip(kernels.FREQUENCIES, kernels.AMPLITUDES, strict=True):
        if (2 * frequency).is_integer():  # on a bin of the two seconds
            assert spectrum[int(2 * frequency)] == pytest.approx(amplitude, rel=0.15)


def test_the_force_balance_is_exact_without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phase, "NOISE", 0.0)
    ratio, supports, response = phase.draw(20, 6, np.random.default_rng(0))
    np.testing.assert_allclose(phase.balance(supports, response), ratio, rtol=1e-8)


def test_guessing_nominal_costs_what_its_formula_says() -> None:
    ratio = np.random.default_rng(0).uniform(0.5, 1.5, 400_000)
    assert phase.guess_error() == pytest.approx(float((np.abs(1 - ratio) / ratio).mean()), rel=0.01)


def test_one_input_needs_no_phases_and_several_do() -> None:
    torch.set_num_threads(1)
    single = phase.network_error("magnitude", 1, windows=2000, updates=150)
    several = phase.network_error("magnitude", 4, windows=2000, updates=150)
    assert single < 0.08
    assert several > 0.2
    assert phase.balance_error(4) < 0.03


def test_state_error_sums_over_samples_and_wraps_angles() -> None:
    true = torch.zeros(2, 100, 2, dtype=torch.float64)
    off = true.clone()
    off[..., 0] = 2 * math.pi + 0.1
    assert metrics.state_error(pendulum.TASK, off, true) == pytest.approx(100 * 0.01)
    moved = torch.zeros(2, 100, 8, dtype=torch.float64)
    moved[:, :, 3] = 0.5
    assert metrics.state_error(two_body.TASK, moved, torch.zeros_like(moved)) == pytest.approx(25.0)


def test_parameter_errors_are_absolute_sums_and_relative_means() -> None:
    estimated, true = torch.tensor([[1.0, 3.0], [2.0, 4.0]]), torch.tensor([[2.0, 4.0], [2.0, 2.0]])
    assert metrics.parameter_error(estimated, true) == pytest.approx(2.0)
    assert metrics.relative_parameter_error(estimated, true) == pytest.approx((0.5 + 0.25 + 0 + 1) / 4)


def test_a_model_in_mirrored_coordinates_is_not_blamed() -> None:
    true = pendulum.TASK.sample(3, np.random.default_rng(0), pendulum.TASK.seen).states
    move = metrics.aligned(pendulum.TASK, -true, true)
    assert metrics.state_error(pendulum.TASK, move(-true), true) == pytest.approx(0, abs=1e-20)
