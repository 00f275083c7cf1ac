"""The simulation with laws in place against an independent integrator, closed forms and energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.special import ellipk

from sprung.model.laws import CATALOGUE, ElementLaw, Motion, SpringDamper
from sprung.model.laws.bodies import with_element
from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray
from sprung.model.simulate.etd import ForceSteps, March, march
from sprung.model.simulate.nonlinear import NonlinearSimulator, Placement, band_limited
from sprung.model.system import load_system, parse_system
from tests.named_laws import element_law

RATE = 100.0
TOY = """
name: toy
sample_rate: 100
window: 100
bodies:
  body: {mass: 400}
  wheel: {mass: 60}
inputs:
  road: {kind: displacement, displacement: {csv: a}, velocity: {csv: b}}
  push: {kind: force, body: body, csv: p}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 2.0e+5, damping: 500}
  strut: {upper: body, lower: wheel, stiffness: 2.0e+4, damping: 1500}
sensors:
  a_body: {kind: acceleration, body: body, noise: 0.01, csv: s1}
  a_wheel: {kind: acceleration, body: wheel, noise: 0.01, csv: s2}
  travel: {kind: deflection, element: strut, noise: 1.0e-5, csv: s3}
  load: {kind: force, element: strut, noise: 1.0, csv: s4}
"""
TRIALS = {  # strong effects at the strut of the toy
    "cubic_stiffness": (5e7,),
    "bump_stop": (0.002, 6e4),
    "progressive_stop": (0.002, 3e4, 0.003, 2e4, 2.0),
    "clearance": (0.002,),
    "coulomb_friction": (60.0, 0.02),
    "damper_blowoff": (0.08, 0.3),
    "damper_asymmetry": (0.4,),
    "quadratic_damping": (4e3,),
    "power_law_damping": (300.0, 0.5, 0.02),
    "series_stiffness": (4e4,),
    "bouc_wen": (2e4, 500.0, 1.0),
    "time_varying_stiffness": (-0.3, 4.0),
    "time_varying_damping": (0.8, 2.0),
    "air_spring": (1e4, 0.05),
    "fractional_stiffness": (1e4, 0.3),
    "stribeck": (40.0, 60.0, 0.1, 0.02),
    "dahl": (60.0, 6e4),
    "lugre": (40.0, 60.0, 0.1, 6e4),
    "pinched_hysteresis": (60.0, 1e-3, 0.6, 2e-3),
    "friction_backlash": (60.0, 2e-3, 6e4),
    "gas_spring": (200.0, 0.05, 1.3),
    "preload": (50.0,),
}

MEMORIES = ("dahl", "lugre", "pinched_hysteresis", "friction_backlash")
# second order at the kinks
KINKED = ("bump_stop", "clearance", "damper_blowoff", "damper_asymmetry", "bouc_wen", *MEMORIES)


def toy() -> Mechanics:
    return parse_system(TOY).mechanics


def drives(mechanics: Mechanics, samples: int, seed: int = 0) -> FloatArray:
    """Knots of smooth random drives: displacements in mm, forces in tens of N."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE
    columns = []
    starts = [(at, 6e-3) for at in mechanics.support_drive] + [(at, 60.0) for at in mechanics.force_drive]
    for _, size in sorted(starts):
        f = rng.uniform(0.5, 14.0, 12)
        phase = rng.uniform(0, 2 * np.pi, 12)
        amplitude = size / f / np.sqrt(12) * 2
        angle = 2 * np.pi * f * t[:, None] + phase
        columns += [(amplitude * np.sin(angle)).sum(1), (amplitude * 2 * np.pi * f * np.cos(angle)).sum(1)]
    return np.stack(columns, axis=1)


def reference(
    mechanics: Mechanics, knots: FloatArray, placements: Sequence[Placement], tolerance: float = 1e-11
) -> FloatArray:
    """States (T, N) by DOP853 from sample to sample; every placement at one element, the laws' clock from 5 s."""
    m, n = mechanics, mechanics.n
    A, B, _, _ = m.matrices()
    t = np.arange(len(knots)) / RATE
    drive = [CubicHermiteSpline(t, knots[:, i], knots[:, i + 1]) for i in range(0, knots.shape[1], 2)]
    slope = [spline.derivative() for spline in drive]
    order = sorted([(at, True) for at in m.support_drive] + [(at, False) for at in m.force_drive])

    def inputs(time: float) -> FloatArray:
        u = np.empty(m.drives)
        for i, (at, support) in enumerate(order):
            u[at] = drive[i](time)
            if support:
                u[at + 1] = slope[i](time)
        return u

    def motion(time: float, x: FloatArray, e: int, u: FloatArray, memory: FloatArray) -> Motion:
        d = m.H[e] @ x[:n] + m.G[e] @ u[m.support_drive]
        v = m.H[e] @ x[n : 2 * n] + m.G[e] @ u[m.support_drive + 1]
        return Motion(d, v, time + 5.0, memory)

    def rhs(time: float, x: FloatArray) -> FloatArray:
        u = inputs(time)
        dx = A @ x[: 2 * n] + B @ u
        memories, at = [], 2 * n
        for placement in placements:
            (e,), law = placement.elements, placement.law
            element = SpringDamper(m.stiffness[e], m.damping[e])
            now = motion(time, x, e, u, x[at : at + law.memory])
            at += law.memory
            dx[n:] -= m.H[e] * law.force(now, placement.p, element) / m.mass
            if law.memory:
                memories.append(law.memory_rate(now, placement.p, element))
        return np.concatenate([dx, *memories])

    x = np.zeros(2 * n)
    for placement in placements:
        e, law = placement.elements[0], placement.law
        now = motion(0.0, x, e, inputs(0.0), np.zeros(0))
        begin = law.memory_start(now, placement.p, SpringDamper(m.stiffness[e], m.damping[e]))
        x = np.concatenate([x, np.broadcast_to(begin, (law.memory,))])
    path = [x]
    for i in range(len(knots) - 1):
        x = solve_ivp(rhs, (t[i], t[i + 1]), x, method="DOP853", rtol=tolerance, atol=1e-13).y[:, -1]
        path.append(x)
    return np.array(path)[:, : 2 * n]


def error(states: FloatArray, truth: FloatArray) -> float:
    return float(np.max(np.abs(states - truth).max(axis=0) / np.abs(truth).max(axis=0)))


@pytest.mark.parametrize("name", TRIALS)
def test_every_law_agrees_with_dop853(name: str) -> None:
    mechanics, law = toy(), element_law(name)
    knots = drives(mechanics, 80)
    placements = [Placement(law, (1,), TRIALS[name])]
    truth = reference(mechanics, knots, placements)
    plain = NonlinearSimulator(mechanics, RATE).run(knots, [])
    assert error(plain.states, truth) > 1e-2  # the law matters
    run = NonlinearSimulator(mechanics, RATE, parts=32).run(knots, placements)
    assert error(run.states, truth) < (1e-5 if name in KINKED else 1e-6)
    coarse = NonlinearSimulator(mechanics, RATE).run(knots, placements)
    assert error(coarse.states, truth) < 2e-3


def test_two_laws_at_once_on_the_whole_vehicle_agree_with_dop853() -> None:
    mechanics = load_system().mechanics
    knots = drives(mechanics, 40)
    placements = [
        Placement(element_law("cubic_stiffness"), (0,), (2e11,)),
        Placement(element_law("coulomb_friction"), (9,), (300.0, 0.002)),
    ]
    truth = reference(mechanics, knots, placements)
    run = NonlinearSimulator(mechanics, RATE, parts=32).run(knots, placements)
    assert error(run.states, truth) < 1e-5


def test_the_error_falls_with_the_fourth_power_of_the_step() -> None:
    mechanics = toy()
    knots = drives(mechanics, 120)
    placements = [Placement(element_law("cubic_stiffness"), (1,), (5e7,))]
    truth = NonlinearSimulator(mechanics, RATE, parts=64).run(knots, placements).states
    errors = [
        error(NonlinearSimulator(mechanics, RATE, parts=parts).run(knots, placements).states, truth)
        for parts in (1, 2, 4)
    ]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (orders > 3.5).all(), orders


@pytest.fixture
def sweeps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The segments of every sweep over a recording."""
    segments: list[int] = []
    plain = march

    def counted(steps: ForceSteps, sites: Any, known: np.ndarray, **how: Any) -> March:
        segments.append(known.shape[2])
        return plain(steps, sites, known, **how)

    monkeypatch.setattr("sprung.model.simulate.segments.march", counted)
    return segments


def test_segments_in_parallel_give_what_one_after_the_other_gives(
    monkeypatch: pytest.MonkeyPatch, sweeps: list[int]
) -> None:
    mechanics = toy()
    knots = drives(mechanics, 700)
    placements = [
        Placement(element_law("bump_stop"), (1,), (0.004, 6e4)),
        Placement(element_law("bouc_wen"), (0,), (2e4, 500.0, 1.0)),
    ]
    simulator = NonlinearSimulator(mechanics, RATE)
    together = simulator.run(knots, placements)
    assert len(sweeps) > 1 and sweeps[-1] > 1
    sweeps.clear()
    monkeypatch.setattr("sprung.model.simulate.segments._WIDTH", 1)
    alone = simulator.run(knots, placements)
    assert sweeps == [1]
    assert error(together.states, alone.states) < 1e-5


def test_without_laws_it_is_the_linear_system() -> None:
    mechanics = toy()
    knots = drives(mechanics, 150)
    run = NonlinearSimulator(mechanics, RATE).run(knots, [])
    assert error(run.states, reference(mechanics, knots, [])) < 1e-9
    np.testing.assert_allclose(run.deflection[:, 1], run.states[:, 0] - run.states[:, 1], rtol=1e-12, atol=1e-15)


def test_a_law_that_only_adds_stiffness_is_a_stiffer_element() -> None:
    mechanics = toy()
    knots = drives(mechanics, 300)
    bar = element_law("anti_roll_bar")  # stiffness times the difference of two deflections
    added = NonlinearSimulator(mechanics, RATE, parts=16).run(knots, [Placement(bar, (1, 0), (3e3,))])
    stiffer = with_element(mechanics, mechanics.H[1] - mechanics.H[0], 3e3, 0.0)
    stiffer.G[-1] = mechanics.G[1] - mechanics.G[0]
    truth = NonlinearSimulator(stiffer, RATE).run(knots, [])
    assert error(added.states, truth.states) < 1e-7
    inner = slice(30, -30)  # away from the anti-alias filter's ends
    np.testing.assert_allclose(added.outputs[inner, :3], truth.outputs[inner, :3], atol=2e-3)


def test_sensors_of_force_and_acceleration_include_the_law() -> None:
    mechanics = toy()
    knots = drives(mechanics, 300)
    run = NonlinearSimulator(mechanics, RATE).run(knots, [Placement(element_law("cubic_stiffness"), (1,), (5e6,))])
    total = 2e4 * run.deflection[:, 1] + 1500 * run.rate[:, 1] + run.force[:, 0]
    inner = slice(30, -30)  # the anti-alias filter does not know what was before and comes after
    np.testing.assert_allclose(run.outputs[inner, 3], total[inner], atol=2e-3 * float(np.std(run.force)))
    np.testing.assert_allclose(
        run.outputs[inner, 0] * 400, -total[inner] + knots[inner, 2], atol=2e-3 * float(np.std(run.force))
    )


def test_the_anti_alias_filter_passes_what_can_be_sampled_and_stops_what_would_fold() -> None:
    parts, rate = 8, 100.0
    t = np.arange(2000 * parts + 1) / (rate * parts)
    low, high = np.sin(2 * np.pi * 40 * t), np.sin(2 * np.pi * 61 * t)
    shown = band_limited(np.stack([low, high], axis=1), parts)
    assert shown.shape == (2001, 2)
    inner = slice(50, -50)
    np.testing.assert_allclose(shown[inner, 0], low[::parts][inner], atol=1e-3)
    assert np.abs(shown[inner, 1]).max() < 1e-3
    np.testing.assert_allclose(band_limited(np.ones((81, 1)), parts), 1.0, atol=1e-6)


def test_friction_takes_out_the_energy_that_leaves_the_free_system() -> None:
    mechanics = toy()
    n = mechanics.n
    conservative = replace(mechanics, damping=np.zeros(2))
    x0 = np.array([0.02, 0.004, 0.1, 0.0])
    run = NonlinearSimulator(conservative, RATE, parts=32).run(
        np.zeros((200, 4)), [Placement(element_law("coulomb_friction"), (1,), (40.0, 0.02))], x0=x0
    )
    q, v = run.states[:, :n], run.states[:, n:]
    energy = 0.5 * v**2 @ conservative.mass + 0.5 * (q @ conservative.H.T) ** 2 @ conservative.stiffness
    motion, force = run.solution.motion[:, 1, 0], run.solution.force[:, 0, 0]
    power = force * motion
    lost = np.concatenate([[0], np.cumsum(0.5 * (power[1:] + power[:-1]))]) / (RATE * run.model.parts)
    np.testing.assert_allclose(energy + lost[:: run.model.parts], energy[0], rtol=1e-4)
    assert (np.diff(energy) <= 1e-12).all()


def test_free_vibration_of_a_duffing_oscillator_has_the_elliptic_period() -> None:
    mechanics = replace(toy(), damping=np.zeros(2))
    mechanics.H[1] = [1.0, 0.0]  # the strut now holds the body to the ground
    k, k3, m, a = 2e4, 5e7, 400.0, 0.01
    run = NonlinearSimulator(mechanics, RATE, parts=16).run(
        np.zeros((400, 4)), [Placement(element_law("cubic_stiffness"), (1,), (k3,))], x0=np.array([a, 0, 0, 0])
    )
    ratio = k3 * a**2 / (2 * (k + k3 * a**2))
    period = 4 * ellipk(ratio) / np.sqrt((k + k3 * a**2) / m)
    t = np.arange(400) / RATE
    v = CubicHermiteSpline(t, run.states[:, 0], run.states[:, 2])
    crossings = v.roots(extrapolate=False)
    assert np.diff(crossings[::2]).mean() == pytest.approx(period, rel=1e-6)


def test_every_element_law_is_covered_here() -> None:
    missing = {law.name for law in CATALOGUE if isinstance(law, ElementLaw)} - set(TRIALS)
    assert missing <= {"anti_roll_bar"}
