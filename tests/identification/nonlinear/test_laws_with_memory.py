"""Windows whose laws remember: their state at the first sample is not known and is estimated beside the values."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sprung.model.identification.identify import load_identifier
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.nonlinear.iterate import Iterate
from sprung.model.identification.nonlinear.sensitivities import LawSensitivities
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.identification.nonlinear.with_laws import acting_laws, without_laws
from sprung.model.system import System, parse_system
from tests.strut import RATE, recorded, road, strut

BOUC_WEN = "{bouc_wen: {alpha: 14000, beta: {value: 150, fixed: true}, n: {value: 1, fixed: true}}}"
SERIES = "{series_stiffness: {ks: 60000}}"
SHAKEN = """
name: on a shaken axle
sample_rate: 100
window: 100
bodies:
  bogie: {mass: 1300}
  car: {mass: 8000}
inputs:
  axle: {kind: displacement, displacement: {csv: d, noise: 1.0e-5}, velocity: {csv: v, noise: 5.0e-4}}
elements:
  primary:
    upper: bogie
    lower: axle
    stiffness: 1.2e+6
    damping: 1.0e+4
    laws: [{series_stiffness: {ks: 1.0e+5}}]
  secondary: {upper: car, lower: bogie, stiffness: 4.3e+5, damping: 2.0e+4}
sensors:
  bogie_a: {kind: acceleration, body: bogie, csv: a, noise: 0.03}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.004}
"""
STOP = "{bump_stop: {gap: 0.004, stiffness: 30000}}"


@pytest.fixture(scope="module")
def hysteretic() -> np.ndarray:
    """Windows of a strut with a Bouc-Wen part of 12 kN/m, beta 150, n 1, with noise."""
    values = recorded(11.0, 5, lambda v, z: 12e3 * z, lambda v, z: v - 150 * (abs(v) * z + 0.5 * v * abs(z)))
    return np.stack([values[i : i + 200] for i in range(200, 1951, 150)])


def test_a_hysteretic_part_and_its_element_are_found_with_calibrated_deviations(hysteretic: np.ndarray) -> None:
    vehicle = strut(BOUC_WEN)
    truth = np.log([1.0, 22 / 20, 14 / 15, 12 / 14])
    estimates = load_identifier(vehicle).identify(hysteretic)
    assert [p.name for p in vehicle.tracked][-1] == "strut.bouc_wen.alpha"
    assert all(e.adequate for e in estimates)
    deviations = np.array([(e.log_ratio - truth) / np.sqrt(np.diag(e.covariance)) for e in estimates])
    assert np.mean(np.abs(deviations) < 3) > 0.95 and 0.6 < np.sqrt(np.mean(deviations**2)) < 1.5
    information = sum(np.linalg.inv(e.covariance) for e in estimates)
    mean = np.linalg.solve(information, sum(np.linalg.inv(e.covariance) @ e.log_ratio for e in estimates))
    std = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.all(np.abs(mean - truth) < 4 * std + 0.002)


@pytest.mark.parametrize("law", [BOUC_WEN, SERIES, STOP])
def test_sensitivities_are_those_of_the_motion_itself(law: str) -> None:
    vehicle = strut(law)
    _, u = road(2.0, 8)
    time = 0.3 + np.arange(200) / RATE
    values = np.zeros((1, 200, 5))
    values[0, :, 0], values[0, :, 1] = u(time), u.derivative()(time)
    columns, expected = _sensitivities(vehicle, values, first=2)  # of the strut, its law, its memory
    assert np.all(_rms(columns - expected) < 0.08 * _rms(expected))


def test_sensitivities_are_right_up_to_the_end_of_the_band_where_a_law_cancels_its_damper() -> None:
    """Between samples the law's force is a spline like the motion: on straight lines damper and law do not cancel."""
    vehicle = parse_system(SHAKEN)
    rng = np.random.default_rng(3)
    frequency, phase = rng.uniform(0.5, 28, 150), rng.uniform(0, 6.3, 150)
    angle = 2 * np.pi * frequency * np.arange(100)[:, None] / 100 + phase
    values = np.zeros((1, 100, 4))
    values[0, :, 0] = (2e-3 / frequency * np.sin(angle)).sum(axis=1)
    values[0, :, 1] = (4e-3 * np.pi * np.cos(angle)).sum(axis=1)
    columns, expected = _sensitivities(vehicle, values)
    columns, expected = (np.fft.rfft(x, axis=1)[:, 1:31] for x in (columns, expected))
    assert np.all(_rms(columns - expected) < 0.15 * _rms(expected))


def _rms(shown: np.ndarray) -> np.ndarray:
    """Of every column of (X, T, R)."""
    return np.asarray(np.sqrt(np.mean(np.abs(shown) ** 2, axis=(1, 2))))


def _sensitivities(vehicle: System, values: np.ndarray, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """To the unknowns from `first` on, and central differences of the simulation, of all sensors in their noise, each
    (X, T, S)."""
    bare, acting = without_laws(vehicle), acting_laws(vehicle)
    T = values.shape[1]
    model = LawWindows(bare, acting, WindowModel(bare, T))
    data = model.model.batch(model.model.knots(values), values, np.ones(len(vehicle.sensors), dtype=bool))
    N, stationary = model.model.states_count, np.zeros((2, 1, T, len(vehicle.elements)))
    unknowns = torch.zeros(1, model.unknowns, dtype=torch.float64)
    start = Iterate(
        unknowns, torch.full((1, N), 1e-3, dtype=torch.float64), torch.zeros(1, T, len(acting), dtype=torch.float64)
    )

    def shown(point: Iterate) -> torch.Tensor:
        for _ in range(2):  # each call takes a few steps of Newton's method
            point, motion, _ = model.settle(point, model.steps(point, data), data)
        return motion.outputs[0] / torch.as_tensor(bare.sensor_noise)

    point, motion, _ = model.settle(start, model.steps(start, data), data)
    steps = model.steps(point, data)
    along = model.along(motion.states, data, stationary, point, steps)
    tangent = model.tangent(along, point, steps)
    columns = LawSensitivities(model).outputs(point, steps, motion, data, stationary, along, tangent)
    back = torch.linalg.pinv(model.model.compression.matrix(data.present))
    whitened = torch.as_tensor(np.diag(1 / bare.sensor_noise)) @ back
    found, expected = [], []
    for at in range(first, model.unknowns):
        size = 1e-3 if at < len(vehicle.tracked) else 1e-5
        moved = torch.zeros_like(unknowns)
        moved[:, at] = size
        up, down = (shown(Iterate(unknowns + sign * moved, start.x0, start.force)) for sign in (1, -1))
        expected.append((up - down).numpy() / (2 * size))
        found.append((columns[0, :, :, N + at] @ whitened.mT).numpy())
    return np.array(found), np.array(expected)
