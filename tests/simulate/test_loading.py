"""Loads: the mass matrix of a body that carries something somewhere, its slopes, and windows that tell where."""

import re

import numpy as np
import pytest
import torch

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.identification.measurements.deviations import CARGO, OWN, deviations
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import ElementValues, LinearSimulator
from sprung.model.simulate.loading import by_inertia, load_terms
from sprung.model.system import MANCHESTER, System, load_system, parse_system
from tests.test_system import QUARTER_CAR

CAR = slice(0, 3)  # z, roll, pitch
MASS, ROLL, PITCH = 32000.0, 56800.0, 1.97e6
CARRIED, AT, ASIDE, OWN_ROLL, OWN_PITCH = 6400.0, 1.5, 0.3, 4000.0, 150e3  # kg, m, m, kg m^2 about its own centre


def described() -> FloatArray:
    """Load, roll, pitch, centre and side of goods of `CARRIED` kg at `AT` m, `ASIDE` m from the middle."""
    mass, roll = MASS + CARRIED, ROLL + OWN_ROLL + CARRIED * ASIDE**2
    pitch = PITCH + OWN_PITCH + CARRIED * AT**2
    load = np.log(mass / MASS)
    grown = [load, np.log(roll / ROLL) - load, np.log(pitch / PITCH) - load]
    return np.array([*grown, CARRIED * AT / np.sqrt(mass * pitch), CARRIED * ASIDE / np.sqrt(mass * roll)])


@pytest.fixture(scope="module")
def system() -> System:
    return load_system()


@pytest.fixture(scope="module")
def simulator(system: System) -> LinearSimulator:
    return LinearSimulator(system)


def values_at(simulator: LinearSimulator, terms: FloatArray) -> ElementValues:
    x = np.concatenate([np.zeros(24), terms])
    return simulator.element_values(torch.as_tensor(x)[None])


def test_the_mass_matrix_is_that_of_the_body_and_what_it_carries(simulator: LinearSimulator) -> None:
    inertia = values_at(simulator, described()).inertia[0].numpy()
    expected = np.diag([MASS + CARRIED, ROLL + OWN_ROLL + CARRIED * ASIDE**2, PITCH + OWN_PITCH + CARRIED * AT**2])
    expected[0, 2] = expected[2, 0] = CARRIED * AT
    expected[0, 1] = expected[1, 0] = CARRIED * ASIDE
    np.testing.assert_allclose(inertia[CAR, CAR], expected, rtol=1e-12, atol=1e-9)
    assert np.count_nonzero(inertia[CAR, 3:]) == 0


def test_forces_accelerate_by_the_inverse_of_the_mass_matrix(simulator: LinearSimulator) -> None:
    forces = torch.as_tensor(np.random.default_rng(1).normal(size=(1, 9, 2)))
    for terms in (np.zeros(5), described()):
        values = values_at(simulator, terms)
        expected = torch.linalg.solve(values.inertia, forces)
        np.testing.assert_allclose(values.accelerated(forces), expected, rtol=1e-10)


def test_slopes_of_the_inertia_forces_agree_with_finite_differences(simulator: LinearSimulator) -> None:
    rng, at, step = np.random.default_rng(2), described(), 1e-6
    acceleration = torch.as_tensor(rng.normal(size=(1, 3, 9)) + 1j * rng.normal(size=(1, 3, 9)))
    here, loading = values_at(simulator, at), simulator.loading
    slopes = by_inertia(acceleration, here.mass, here.coupling, loading.exponents, loading.pattern)
    for i, unit in enumerate(np.eye(5)):
        up, down = (values_at(simulator, at + sign * step * unit).inertia.to(acceleration.dtype) for sign in (1, -1))
        expected = (acceleration @ (up - down)) / (2 * step)
        np.testing.assert_allclose(slopes[..., i], expected, rtol=1e-6, atol=1e-3)


def test_a_body_without_axes_has_a_mass_alone() -> None:
    assert [term.kind for term in load_terms(parse_system(QUARTER_CAR))] == ["load"]


def test_windows_determine_where_goods_lie_and_change_no_spring(system: System) -> None:
    x = np.tile(np.concatenate([np.zeros(24), described()]), (24, 1))
    runs = simulate_runs(system, x, system.window, np.random.default_rng(3))
    alone = Refiner(system).refine(runs.values)
    found = Refiner(system).refine(runs.values, loads=True)
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    score = (found.log_ratio - x)[:, :24] / std[:, :24]
    assert 0.85 < np.sqrt(np.mean(score**2)) < 1.15
    weight = std[:, 24:] ** -2
    mean = (found.log_ratio[:, 24:] * weight).sum(axis=0) / weight.sum(axis=0)
    assert abs(mean[0] - described()[0]) < 0.03
    assert np.median(alone.chi_square) > 1.1 * np.median(found.chi_square)


def test_what_windows_say_of_a_load_does_not_hold_their_prior(system: System) -> None:
    """Summed over many windows, information and score lead to the truth, not to the middle of what is likely."""
    x = np.tile(np.concatenate([np.zeros(24), described()]), (48, 1))
    runs = simulate_runs(system, x, system.window, np.random.default_rng(4))
    kinds = [d.kind for d in deviations(system)]
    at, along = ([i for i, kind in enumerate(kinds) if kind in of] for of in (CARGO, (*CARGO, *OWN)))
    total, pull = np.zeros((5, 5)), np.zeros(5)
    for estimate in Identifier(system).examine(runs.values, np.zeros(48, dtype=bool)):
        said = estimate.deviating
        assert said is not None
        total += said.information[np.ix_(at, at)]
        pull += said.score[at] + said.information[np.ix_(at, along)] @ said.point[along]  # bodies are as drawn
    found, std = np.linalg.solve(total, pull), np.sqrt(np.diag(np.linalg.inv(total)))
    assert np.abs((found - described()) / std).max() < 3.5
    assert std[3] < 0.01 and std[4] < 0.01


def test_stiffness_that_follows_the_load_is_reported_as_that_of_the_empty_body() -> None:
    """Air springs: at 20 % more weight they are 20 % stiffer, and nothing has changed."""
    text = MANCHESTER.read_text()
    aired = re.sub(r"(secondary_\d[lr]: \{)", r"\1by_load: 1, ", text)
    system, steel = parse_system(aired), parse_system(text)
    assert aired != text and system.digest != steel.digest
    x = np.tile(np.concatenate([np.zeros(24), [np.log(1.2), 0.0, 0.0, 0.0, 0.0]]), (24, 1))
    runs = simulate_runs(system, x, system.window, np.random.default_rng(5))
    found, taken = (Refiner(one).refine(runs.values, loads=True) for one in (system, steel))
    secondary = [i for i, p in enumerate(system.parameters) if p.name.startswith("secondary") and "stiff" in p.name]
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert 0.8 < np.sqrt(np.mean((found.log_ratio[:, :24] / std[:, :24]) ** 2)) < 1.2
    assert abs(np.median(found.log_ratio[:, secondary])) < 0.02
    assert np.median(taken.log_ratio[:, secondary]) == pytest.approx(np.log(1.2), abs=0.03)


def test_slopes_along_loads_of_air_springs_and_along_how_bogies_are_built_agree_with_finite_differences() -> None:
    system = parse_system(re.sub(r"(secondary_\d[lr]: \{)", r"\1by_load: 0.8, ", MANCHESTER.read_text()))
    x = np.tile(np.concatenate([np.zeros(24), described(), np.full(8, 0.02)]), (2, 1))
    runs = simulate_runs(system, x, system.window, np.random.default_rng(6))
    model = Refiner(system).model
    data = model.batch(model.knots(runs.clean), runs.clean, np.ones(len(system.sensors), dtype=bool))
    ratio = torch.as_tensor(x)
    at = model.linearise(ratio, data)
    known = torch.linalg.qr(at.free.mT)[0]
    for row in (24, 27, 28, *range(29, 33)):  # the last ones: how a bogie is built
        step = torch.zeros_like(ratio)
        step[:, row] = 1e-5
        up, down = (model.chord(at, ratio + sign * step, at.x0, data).residual for sign in (1, -1))
        expected, slope = (down - up) / 2e-5, at.sensitivities[:, row, :, None]
        expected, slope = (v - known @ (known.mT @ v) for v in (expected, slope))
        assert float((expected - slope).norm() / expected.norm()) < 0.01
