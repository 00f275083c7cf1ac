"""Frequency responses, branches and polynomial motions against the state equations."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.structure import Branch, Structure
from sprung.model.system import load_system
from tests.diagnosis_cases import quarter_car


def test_plant_agrees_with_the_state_equations() -> None:
    system = load_system()
    grid = Grid(400, 0.01)
    plant = Plant(Structure.nominal(system.mechanics, np.arange(12)), grid)
    A, B, C, D = system.mechanics.matrices()
    for j in (3, 40, 150):
        s = 1j * grid.omega[j]
        states = C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D
        expected = states[:, system.mechanics.support_drive] + s * states[:, system.mechanics.support_drive + 1]
        np.testing.assert_allclose(plant.sensor_of_support[j], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("branch", [Branch(10, 1.2e6, 0.03, 36000.0), Branch(2, 3e5, 0.2, 0.0)])
def test_branches_act_alike_in_frequency_and_in_free_motion(branch: Branch) -> None:
    """Maxwell branch in place of a damper, and beside one (air spring): receptance against the state equations."""
    system = load_system()
    grid = Grid(400, 0.01)
    structure = replace(Structure.nominal(system.mechanics, np.arange(12)), branches=(branch,))
    plant = Plant(structure, grid)
    A, n = structure.state_matrix(), system.mechanics.n
    assert len(A) == 2 * n + 1
    assert np.linalg.eigvals(A).real.max() < 0
    loads = np.vstack([np.zeros((n, n)), np.diag(1 / structure.mass), np.zeros((1, n))])
    for j in (1, 20, 150):
        states = np.linalg.solve(1j * grid.omega[j] * np.eye(len(A)) - A, loads)
        np.testing.assert_allclose(states[:n], plant.receptance[j], rtol=1e-8, atol=1e-16)
        force = structure.branch_forces((structure.H[None] @ states[:n, 0]).astype(complex), grid.omega[j : j + 1])
        np.testing.assert_allclose(states[2 * n, 0], force[0, 0], rtol=1e-8)


def test_polynomial_response_solves_the_equations_of_motion() -> None:
    system = quarter_car()
    grid = Grid(500, 0.01)
    plant = Plant(Structure.nominal(system.mechanics, np.arange(4)), grid)
    load = np.zeros((6, 2))
    load[:4] = np.random.default_rng(0).standard_normal((4, 2)) * 1e3
    q = plant.polynomial_response(load)
    s = plant.structure
    v = plant.derivative(q)
    balance = plant.derivative(v) * s.mass + v @ s.C.T + q @ s.K.T
    np.testing.assert_allclose(balance, load, atol=1e-6)
