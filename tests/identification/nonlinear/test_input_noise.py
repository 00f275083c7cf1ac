"""Noise of the inputs that laws carry to the sensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sprung.model.identification.identify import load_identifier
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.nonlinear.iterate import Iterate
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.identification.nonlinear.with_laws import acting_laws, without_laws
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import parse_system
from tests.strut import RATE, road, strut

HARD = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {mass: 1300}
  car: {mass: 8000}
inputs:
  road: {kind: displacement, displacement: {csv: d, noise: 1.0e-5}, velocity: {csv: v, noise: 5.0e-4}}
elements:
  tyre:
    upper: wheel
    lower: road
    stiffness: 2.4e+6
    damping: 1.0e+4
    laws: [{bump_stop: {gap: 0.001, stiffness: 6.0e+6}}]
  strut: {upper: car, lower: wheel, stiffness: 4.3e+5, damping: 2.0e+4}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a, noise: 0.02}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.004}
"""


@pytest.mark.parametrize(
    "law", ["{bouc_wen: {alpha: 14000, beta: 150, n: 1}}", "{bump_stop: {gap: 0.004, stiffness: 30000}}"]
)
def test_forces_followed_backwards_are_the_transpose_of_those_followed_forwards(law: str) -> None:
    random = torch.Generator().manual_seed(4)
    tangent = _flow(law)
    Z, (B, T, L) = len(tangent.memories), tangent.slopes[0].shape

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=random)

    deflection, rate = drawn(B, T, L, 1), drawn(B, T, L, 1)
    path = tangent.run(
        torch.zeros(B, T - 1, 4, 1, dtype=torch.float64),
        tangent.along(deflection, rate)[0],
        torch.zeros(B, 4, 1, dtype=torch.float64),
        tangent.along(deflection, rate)[1],
    )
    by_state, by_force = drawn(B, T, 4, 1), drawn(B, T, L, 1)
    forwards = (path[:, :, :4] * by_state).sum() + (path[:, :, 4:] * by_force).sum()
    added, remembered = tangent.adjoint(by_state, by_force)
    assert remembered.shape == (B, T - 1, Z, 1)
    by_deflection, by_rate = tangent.along_adjoint(added, remembered)
    backwards = (by_deflection * deflection).sum() + (by_rate * rate).sum()
    assert float(backwards) == pytest.approx(float(forwards), rel=1e-9)


def _flow(law: str) -> TangentModel:
    vehicle = strut(law)
    bare = without_laws(vehicle)
    model = LawWindows(bare, acting_laws(vehicle), WindowModel(bare, 200))
    _, u = road(2.0, 8)
    time = 0.3 + np.arange(200) / RATE
    values = np.zeros((1, 200, 5))
    values[0, :, 0], values[0, :, 1] = u(time), u.derivative()(time)
    data = model.model.batch(model.model.knots(values), values, np.ones(3, dtype=bool))
    zero = torch.zeros(1, model.unknowns, dtype=torch.float64)
    start = Iterate(zero, torch.full((1, 4), 1e-3, dtype=torch.float64), torch.zeros(1, 200, 1, dtype=torch.float64))
    stationary = np.zeros((2, 1, 200, 2))
    point, motion, _ = model.settle(start, model.steps(start, data), data)
    steps = model.steps(point, data)
    return model.tangent(model.along(motion.states, data, stationary, point, steps), point, steps)


def test_deviations_contain_the_noise_of_inputs_that_a_stop_makes_larger() -> None:
    """One motion with sixty draws of noise: values scatter as they say."""
    vehicle, random = parse_system(HARD), np.random.default_rng(3)
    time = np.arange(600) / 200
    w, phase = random.uniform(3, 60, 14), random.uniform(0, 2 * np.pi, 14)
    size = 0.01 / w
    driven = np.stack(
        [
            (size * np.sin(w * time[:, None] + phase)).sum(axis=1),
            (size * w * np.cos(w * time[:, None] + phase)).sum(axis=1),
        ],
        axis=1,
    )
    clean = np.concatenate([driven, simulate_ride(vehicle, driven).sensors], axis=1)[300:500]
    noise = np.array([1e-5, 5e-4, 0.02, 0.004])
    estimates = load_identifier(vehicle).identify(clean + noise * random.standard_normal((60, 200, 4)))
    estimates = [e for e in estimates if e.adequate]
    values = np.array([e.log_ratio for e in estimates])
    stated = np.median([np.sqrt(np.diag(e.covariance)) for e in estimates], axis=0)
    assert len(estimates) > 55
    assert np.all(values.std(axis=0) < 1.3 * stated) and np.all(stated < 1.4 * values.std(axis=0))
