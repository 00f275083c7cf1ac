"""Sensitivities along a run against finite differences of whole runs."""

from __future__ import annotations

import numpy as np
import pytest
from test_nonlinear import RATE, TRIALS, drives, toy

from model.diagnosis.catalogue import find_law
from model.simulate.nonlinear import NonlinearSimulator, Placement
from model.simulate.nonlinear_sensitivity import sensitivities

SMOOTH = ("cubic_stiffness", "series_stiffness", "air_spring", "coulomb_friction", "time_varying_damping")
INNER = slice(5, -25)
X0 = np.array([1e-3, 2e-4, 0.01, 0.02])


def difference(mechanics, knots, law, p, change):
    """Central difference of the outputs; `change(h)` gives what is moved."""
    h = 1e-4
    simulator = NonlinearSimulator(mechanics, RATE, parts=16)
    sides = []
    for sign in (1, -1):
        moved = {"p": p, "x0": X0, **change(sign * h)}
        placement = Placement(law, (1,), tuple(moved.pop("p")))
        sides.append(simulator.run(knots, [placement], **moved).outputs)
    return (sides[0] - sides[1]) / (2 * h)


@pytest.mark.parametrize("name", ["cubic_stiffness", "bump_stop", "coulomb_friction", "series_stiffness"])
def test_sensitivities_are_the_derivatives_of_the_simulation(name):
    mechanics, law, p = toy(), find_law(name), np.array(TRIALS[name])
    knots = drives(mechanics, 180)
    run = NonlinearSimulator(mechanics, RATE, parts=16).run(knots, [Placement(law, (1,), tuple(p))], x0=X0)
    found = sensitivities(run)
    one, other = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    state = 1e-2 * np.eye(4)[3]
    pairs = [
        (found.stiffness[:, :, 0], lambda h: {"stiffness": mechanics.stiffness * np.exp(h * one)}),
        (found.damping[:, :, 1], lambda h: {"damping": mechanics.damping * np.exp(h * other)}),
        (found.mass[:, :, 1], lambda h: {"mass": mechanics.mass * np.exp(h * other)}),
        (found.first_state[:, :, 3] * 1e-2, lambda h: {"x0": X0 + h * state}),
    ]
    for j in range(len(p)):
        pairs.append((found.laws[:, :, j] * p[j], lambda h, j=j: {"p": p * (1 + h * (np.arange(len(p)) == j))}))
    limit = 0.01 if name in SMOOTH else 0.04  # a kink moved by a finite difference is passed at another step
    for mine, change in pairs:
        theirs = difference(mechanics, knots, law, p, change)
        error = np.sqrt(np.mean((mine - theirs)[INNER] ** 2) / np.mean(theirs[INNER] ** 2))
        assert error < limit


def test_two_laws_feel_each_other():
    mechanics = toy()
    knots = drives(mechanics, 250)
    placements = [
        Placement(find_law("coulomb_friction"), (1,), (60.0, 0.02)),
        Placement(find_law("air_spring"), (0,), (3e4, 0.05)),
    ]
    simulator = NonlinearSimulator(mechanics, RATE, parts=16)
    found = sensitivities(simulator.run(knots, placements))
    assert found.laws.shape == (250, 4, 4)
    h = 1e-3
    sides = [
        simulator.run(knots, [placements[0], Placement(placements[1].law, (0,), (3e4 * (1 + s * h), 0.05))]).outputs
        for s in (1, -1)
    ]
    theirs = (sides[0] - sides[1]) / (2 * h)
    mine = found.laws[:, :, 2] * 3e4
    assert np.sqrt(np.mean((mine - theirs)[INNER] ** 2) / np.mean(theirs[INNER] ** 2)) < 0.01


def test_segments_do_not_show(monkeypatch):
    mechanics = toy()
    knots = drives(mechanics, 450)
    run = NonlinearSimulator(mechanics, RATE).run(knots, [Placement(find_law("bouc_wen"), (1,), TRIALS["bouc_wen"])])
    many = sensitivities(run)
    monkeypatch.setattr("model.simulate.nonlinear_sensitivity._SEGMENT", 10_000)
    one = sensitivities(run)
    for a, b in ((many.stiffness, one.stiffness), (many.laws, one.laws), (many.first_state, one.first_state)):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9 * np.abs(b).max())


def test_without_laws_they_are_the_linear_system_s():
    mechanics = toy()
    knots = drives(mechanics, 200)
    simulator = NonlinearSimulator(mechanics, RATE)
    found = sensitivities(simulator.run(knots, []))
    h = 1e-5
    for i in range(2):
        moved = [
            simulator.run(knots, [], damping=mechanics.damping * np.exp(s * h * (np.arange(2) == i))).outputs
            for s in (1, -1)
        ]
        theirs = (moved[0] - moved[1]) / (2 * h)
        np.testing.assert_allclose(found.damping[:, :, i], theirs, atol=2e-3 * np.abs(theirs).max())
