"""Two measurements of one support's motion: what they say of each other, whatever the vehicle does."""

import numpy as np
import pytest
import torch

from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.signals import FloatArray
from sprung.model.simulate import fusion
from sprung.model.system import BUNDLED, load_system

KEYS = [((0, 1e-5), (1, 5e-4)), ((0, 1e-5), (2, 0.1)), ((1, 1e-3), (2, 0.1)), ((0, 1e-5), (1, 5e-4), (2, 0.1))]


@pytest.fixture(scope="module")
def calibration() -> DeviationSensitivity:
    return DeviationSensitivity(WindowModel(load_system(), 100))


def motions(
    rng: np.random.Generator, count: int, samples: int = 100, rate: float = 100.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Windows (B, T) of displacements below 10 Hz, their velocities and accelerations."""
    frequency = np.arange(1, 121) / 12.0
    omega, time = 2 * np.pi * frequency, np.arange(samples) / rate
    size = 2e-4 / frequency
    phase = rng.uniform(0, 2 * np.pi, (count, len(omega), 1))
    angle = omega[:, None] * time + phase
    return (
        (size[:, None] * np.cos(angle)).sum(axis=1),
        -((size * omega)[:, None] * np.sin(angle)).sum(axis=1),
        -((size * omega**2)[:, None] * np.cos(angle)).sum(axis=1),
    )


@pytest.mark.parametrize("key", KEYS)
def test_what_a_fit_leaves_is_a_projection_that_a_motion_passes(
    key: tuple[tuple[int, float], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    z = rng.standard_normal((4, 60, len(key)))
    dense = fusion.left_by_motion(z, 0.01, key)
    monkeypatch.setattr(fusion, "_DENSE", 10)
    np.testing.assert_allclose(fusion.left_by_motion(z, 0.01, key), dense, atol=1e-6)
    np.testing.assert_allclose(fusion.left_by_motion(dense, 0.01, key), dense, atol=1e-6)
    true = motions(rng, 3, 60)
    clean = np.stack([true[order] / std for order, std in key], axis=2)
    assert np.abs(fusion.left_by_motion(clean, 0.01, key)).max() < 2e-3 * np.abs(clean).max()


def inputs(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Windows (B, T, 16) of the bundled vehicle's wheels, and their noise."""
    d, v, _ = motions(rng, 8 * count)
    both = np.stack([d, v], axis=2).reshape(count, 8, 100, 2)
    return np.moveaxis(both, 1, 2).reshape(count, 100, 16), np.tile([1e-5, 5e-4], 8)


def of_inputs(calibration: DeviationSensitivity, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    found = calibration.redundancy.evidence(torch.as_tensor(values), calibration.slope, calibration.bins)
    assert found is not None
    return found[0].numpy(), found[1].numpy()


def test_what_it_says_of_gains_and_delays_is_as_uncertain_as_stated(calibration: DeviationSensitivity) -> None:
    rng = np.random.default_rng(2)
    clean, noise = inputs(rng, 60)
    information, score = of_inputs(calibration, clean + noise * rng.standard_normal(clean.shape))
    told = np.flatnonzero(information[0].diagonal() > 0)
    assert list(told) == [*range(16), *range(28, 44)]
    z = score[:, told] / np.sqrt(np.einsum("bhh->bh", information)[:, told])
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(60)


@pytest.mark.parametrize(("column", "gain"), [(2, 0.02), (5, -0.03)])
def test_a_gain_of_one_of_two_measurements_is_found_from_the_other(
    calibration: DeviationSensitivity, column: int, gain: float
) -> None:
    rng = np.random.default_rng(3)
    clean, noise = inputs(rng, 20)
    clean[:, :, column] *= 1 + gain
    information, score = of_inputs(calibration, clean + noise * rng.standard_normal(clean.shape))
    told = information[:, column, column].sum()
    assert abs(score[:, column].sum() / told - gain) < 4 / np.sqrt(told) + 0.05 * abs(gain)
    others = [c for c in range(16) if c // 2 != column // 2]
    z = score[:, others].sum(axis=0) / np.sqrt(np.einsum("bhh->h", information)[others])
    assert np.abs(z).max() < 4


def test_a_support_that_is_measured_once_says_nothing() -> None:
    system = load_system(BUNDLED / "axleboxes.yaml")
    calibration = DeviationSensitivity(WindowModel(system, 100))
    values = torch.zeros(2, 100, len(system.inputs), dtype=torch.float64)
    assert calibration.redundancy.evidence(values, calibration.slope, calibration.bins) is None
