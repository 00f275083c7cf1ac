"""The diagnosis' numerical pieces against closed forms and other integrators."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_cases import DAMPING, STIFFNESS, quarter_car, simulate

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.noise import input_noise
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, transform
from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.structure import Branch, Structure
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.response.time_stepping import march_forces
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.laws import SpringDamper, find_law
from sprung.model.laws.along import force_along
from sprung.model.laws.trajectory import along
from sprung.model.system import load_system


def _problem(record, system=None):
    system = system or quarter_car()
    signals = prepare(system, record.values, record.sample_rate).signals
    noise = declared_noise(system, signals)
    return Problem(system, transform(signals, noise), signals.sensor_index, noise)


def _truth(system):
    values = [(STIFFNESS if p.quantity == "stiffness" else DAMPING)[p.element] for p in system.parameters]
    return np.log(np.array(values) / system.nominal)


def test_plant_agrees_with_the_state_equations():
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
def test_branches_act_alike_in_frequency_and_in_free_motion(branch):
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
        force = structure.branch_forces(structure.H[None] @ states[:n, 0], grid.omega[j : j + 1])
        np.testing.assert_allclose(states[2 * n, 0], force[0, 0], rtol=1e-8)


def test_polynomial_response_solves_the_equations_of_motion():
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


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("gamma", [0.5, -1.4, -1.0, 0.0, 1.5])
def test_bouc_wen_from_reversal_to_reversal_agrees_with_integration(exponent, gamma):
    time = np.arange(6000) / 1000
    d = 3e-3 * np.sin(2 * np.pi * 1.3 * time) + 1e-3 * np.sin(2 * np.pi * 4.1 * time + 1)
    v = np.gradient(d, time)
    law, p = find_law("bouc_wen").wider, (9e4, 300.0**exponent, exponent, gamma)
    element = SpringDamper(4e5, 2e4)
    fast = force_along(law, p, d, v, time, element)
    slow = along(law, p, d, v, sample_rate=1000.0, element=element)
    np.testing.assert_allclose(fast, slow, atol=3e-3 * np.abs(slow).max())


def test_parameters_come_back_within_their_uncertainty():
    problem = _problem(simulate(seed=1))
    fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    z = (fit.point.theta - _truth(problem.system)) / np.sqrt(np.diag(fit.covariance))
    assert fit.converged
    assert np.abs(z).max() < 4
    assert 0.9 < fit.reduced < 1.1


def test_sensitivities_agree_with_finite_differences():
    problem = _problem(simulate(lambda d, v: 4e9 * d**3, seed=2, seconds=12))
    law = find_law("cubic_stiffness")
    term = Term(law, "secondary", (4e9,), scales=(4e9,))
    start = Point(_truth(problem.system), (term,), np.zeros(4))
    fit = optimise(problem, start, iterations=4)
    point = fit.point
    working = Working(fit.whitener)
    here = linearise(problem, point, working)
    free, _ = np.linalg.qr(here.jacobian[:, -4:])
    for i in range(4):
        move = np.zeros(4)
        move[i] = 1e-4
        up = linearise(problem, Point(point.theta + move, point.terms, point.state), working).residual
        down = linearise(problem, Point(point.theta - move, point.terms, point.state), working).residual
        expected = -(up - down) / 2e-4
        error = here.jacobian[:, i] - expected
        error -= free @ (free.T @ error)  # the ends of the part move as a free motion, which is fitted anyway
        assert np.linalg.norm(error) < 0.03 * np.linalg.norm(expected)


def test_law_with_true_values_explains_a_recording_that_the_linear_model_cannot():
    problem = _problem(simulate(lambda d, v: 4e9 * d**3, seed=3))
    plain = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    term = Term(find_law("cubic_stiffness"), "secondary", (3e9,), scales=(3e9,))
    fit = optimise(problem, Point(plain.point.theta, (term,), plain.point.state), whitener=plain.whitener)
    value, sigma = fit.point.terms[0].parameters[0], np.sqrt(fit.covariance[-1, -1])
    assert plain.reduced > 2
    assert fit.reduced < 1.1
    assert abs(value - 4e9) < 4 * sigma


@pytest.mark.parametrize(
    ("law", "values", "settles"), [("coulomb_friction", (300.0, 0.01), True), ("bump_stop", (4e-3, 1e6), False)]
)
def test_forces_marched_in_time_are_those_of_the_whole_trajectory(law, values, settles):
    """Steps in time lead to the forces of the iteration, also where that does not settle from its own start."""
    problem = _problem(simulate(seed=6))
    point = Point(_truth(quarter_car()), (Term(find_law(law), "secondary", values),), np.zeros(4))
    forward = problem.forward(point)
    alone = forward.law_forces(point.state)
    assert alone is not None and alone.converged is settles
    marched = march_forces(forward, point.state)
    led = replace(forward, start_force=tuple(marched.T)).law_forces(point.state)
    assert led is not None and led.converged
    inside = slice(400, -100)  # the marched one is not periodic at the ends
    difference = marched[inside, 0] - led.force[inside, 0]
    assert np.std(difference) < 0.02 * np.std(led.force[inside, 0])


def test_input_noise_is_told_by_the_second_measurement():
    record = simulate(seed=4)
    rng = np.random.default_rng(5)
    record.values[:, 1] += 1e-3 * rng.standard_normal(len(record.values))
    problem = _problem(record)
    noise = input_noise(problem.part, problem.noise)
    assert noise.displacement[0] == pytest.approx(1e-5, rel=0.1)
    assert noise.velocity[0] == pytest.approx(np.hypot(5e-4, 1e-3), rel=0.1)


def test_scores_on_a_clean_recording_are_chi_square():
    laws = (find_law("cubic_stiffness"), find_law("quadratic_damping"), find_law("damper_asymmetry"))
    scores = []
    for seed in range(6):
        problem = _problem(simulate(seed=10 + seed, seconds=12))
        fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
        hits = screen(problem, fit, laws).candidates
        scores += [h.score for h in hits if h.family is ELEMENT]
    assert np.mean(scores) < 2.5  # one-sided laws drop out when their sign is wrong
    assert np.max(scores) < 20
