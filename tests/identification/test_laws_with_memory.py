"""Windows whose laws remember: their state at the first sample is not known and is estimated beside the values."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sprung.model.identification.identify import load_identifier
from sprung.model.identification.law_iterate import Iterate
from sprung.model.identification.law_window import LawWindows
from sprung.model.identification.linearise import WindowModel
from sprung.model.identification.with_laws import acting_laws, without_laws
from tests.strut import RATE, recorded, road, strut

BOUC_WEN = "{bouc_wen: {alpha: 14000, beta: {value: 150, fixed: true}, n: {value: 1, fixed: true}}}"
SERIES = "{series_stiffness: {ks: 60000}}"
STOP = "{bump_stop: {gap: 0.004, stiffness: 30000}}"


@pytest.fixture(scope="module")
def hysteretic() -> np.ndarray:
    """Windows of a strut with a Bouc-Wen part of 12 kN/m, beta 150, n 1, with noise."""
    values = recorded(11.0, 5, lambda v, z: 12e3 * z, lambda v, z: v - 150 * (abs(v) * z + 0.5 * v * abs(z)))
    return np.stack([values[i : i + 200] for i in range(200, 1951, 150)])


def test_a_hysteretic_part_and_its_element_are_found_with_honest_deviations(hysteretic: np.ndarray) -> None:
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
    bare, acting = without_laws(vehicle), acting_laws(vehicle)
    model = LawWindows(bare, acting, WindowModel(bare, 200))
    _, u = road(2.0, 8)
    time = 0.3 + np.arange(200) / RATE
    values = np.zeros((1, 200, 5))
    values[0, :, 0], values[0, :, 1] = u(time), u.derivative()(time)
    data = model.model.batch(model.model.knots(values), values, np.ones(3, dtype=bool))
    stationary = np.zeros((2, 1, 200, 2))
    unknowns = torch.zeros(1, model.unknowns, dtype=torch.float64)
    start = Iterate(
        unknowns, torch.full((1, 4), 1e-3, dtype=torch.float64), torch.zeros(1, 200, 1, dtype=torch.float64)
    )

    def shown(point: Iterate) -> torch.Tensor:
        for _ in range(2):  # each call takes a few steps of Newton's method
            point, motion, _ = model.settle(point, model.steps(point, data), data)
        return motion.outputs / torch.as_tensor(bare.sensor_noise)

    point, motion, _ = model.settle(start, model.steps(start, data), data)
    steps = model.steps(point, data)
    along = model.along(motion.states, data, stationary, point, steps)
    tangent = model.tangent(along, point, steps)
    columns = model.output_sensitivities(point, steps, motion, data, stationary, along, tangent)
    back = torch.linalg.pinv(model.model.compression.matrix(data.present))
    whitened = torch.as_tensor(np.diag(1 / bare.sensor_noise)) @ back
    for at in range(2, model.unknowns):  # of the strut, its law, its memory
        size = 1e-3 if at < len(vehicle.tracked) else 1e-5
        moved = torch.zeros_like(unknowns)
        moved[:, at] = size
        up, down = (shown(Iterate(unknowns + sign * moved, start.x0, start.force)) for sign in (1, -1))
        expected = (up - down) / (2 * size)
        found = columns[..., 4 + at] @ whitened.mT
        assert (found - expected).square().mean().sqrt() < 0.08 * expected.square().mean().sqrt()
