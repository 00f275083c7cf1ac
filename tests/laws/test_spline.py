"""A restoring force found without a law, against the force that was put in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sprung.model.laws import ElementLaw
from sprung.model.laws.spline import Axis, LatentForce, Surface, estimate_force
from sprung.model.signals import FloatArray
from sprung.model.simulate.nonlinear import DiscreteSystem, NonlinearRun, NonlinearSimulator, Placement
from sprung.model.simulate.stepping import cubic_chain, exact_steps
from sprung.model.system import parse_system
from tests.named_laws import element_law

RATE, SAMPLES, NOISE = 100.0, 2000, np.array([0.01, 0.05])
SYSTEM = """
name: toy
sample_rate: 100
window: 100
bodies:
  body: {mass: 400}
  wheel: {mass: 60}
inputs:
  road: {kind: displacement, displacement: {csv: a}, velocity: {csv: b}}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 2.0e+5, damping: 500}
  strut: {upper: body, lower: wheel, stiffness: 2.0e+4, damping: 1500}
sensors:
  a_body: {kind: acceleration, body: body, noise: 0.01, csv: s1}
  a_wheel: {kind: acceleration, body: wheel, noise: 0.05, csv: s2}
"""
MECHANICS = parse_system(SYSTEM).mechanics
Force = Callable[[FloatArray, FloatArray], FloatArray]  # of deflection, m, and rate, m/s; N


def hidden(name: str, force: Force) -> ElementLaw:
    """A law that is not in the catalogue."""
    return replace(element_law("damper_asymmetry"), name=name, force=lambda m, p, e: force(m.deflection, m.rate))


TRUTHS: dict[str, Force] = {
    "quadratic stiffness": lambda d, v: 1.5e5 * d**2,
    "position-dependent damping": lambda d, v: 6e6 * d**2 * v,
    "nothing": lambda d, v: 0.0 * d,
}


def road(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / RATE
    f = rng.uniform(0.4, 12, 60)
    angle = 2 * np.pi * f * t[:, None] + rng.uniform(0, 2 * np.pi, 60)
    size = 1e-3 / f
    return np.stack([(size * np.sin(angle)).sum(1), (size * 2 * np.pi * f * np.cos(angle)).sum(1)], axis=1)


def respond_of(model: DiscreteSystem) -> Callable[[FloatArray], FloatArray]:
    """Whitened answers of the sensors to forces (T, m) along the strut."""
    n = model.mechanics.n
    pull = np.concatenate([np.zeros(n), -model.mechanics.H[1] / model.mechanics.mass])[:, None]
    at_once = -(model.mechanics.S / model.mechanics.mass) @ model.mechanics.H[1]
    steps = exact_steps(model.A, pull, np.zeros_like(pull), 1 / RATE, 1)

    def respond(forces: FloatArray) -> FloatArray:
        slopes = CubicSpline(np.arange(len(forces)) / RATE, forces)(np.arange(len(forces)) / RATE, 1)
        knots = np.stack([forces, slopes], axis=2).transpose(1, 0, 2)  # (m, T, 2)
        chain = cubic_chain(knots, 1 / RATE).transpose(1, 2, 0)  # (T-1, 4, m)
        states = steps.path(chain, np.zeros((2 * n, forces.shape[1])))
        answers = np.einsum("sn,tnm->tsm", model.C, states) + at_once[:, None] * forces[:, None, :]
        return (answers / NOISE[:, None]).reshape(-1, forces.shape[1])

    return respond


def found(name: str, rounds: int = 4, seed: int = 0) -> tuple[NonlinearRun, LatentForce, NonlinearRun]:
    """Measure, then let the estimate of the surface and the fit of the strut's spring and damper take turns."""
    knots, rng = road(seed), np.random.default_rng(seed + 100)
    simulator = NonlinearSimulator(MECHANICS, RATE)
    truth = simulator.run(knots, [Placement(hidden(name, TRUTHS[name]), (1,), (1.0,))])
    measured = truth.outputs + NOISE * rng.standard_normal(truth.outputs.shape)
    values = np.array([MECHANICS.stiffness[1], MECHANICS.damping[1]])
    run, surface = simulator.run(knots, []), None
    latent: LatentForce | None = None
    for _ in range(rounds):
        d, v = run.deflection[:, 1], run.rate[:, 1]
        surface = surface or Surface.over(d, v)
        respond = respond_of(run.model)
        residual = ((measured - run.outputs) / NOISE).ravel()
        jacobian = respond(np.stack([d, v], axis=1))
        before = latent.force(d, v) if latent else 0.0
        latent = estimate_force(surface, (d, v), respond, residual, jacobian, current=latent)
        change = latent.force(d, v) - before
        values = values + np.linalg.lstsq(jacobian, residual - respond(change[:, None])[:, 0])[0]
        run = simulator.run(
            knots,
            [Placement(latent.law(), (1,), (1.0,))],
            stiffness=np.array([MECHANICS.stiffness[0], values[0]]),
            damping=np.array([MECHANICS.damping[0], values[1]]),
        )
    assert latent is not None
    return truth, latent, run


def without_linear(latent: LatentForce, d: FloatArray, v: FloatArray, force: Force) -> FloatArray:
    """The force less what spring, damper and a static load explain along the estimated motion."""
    seen_d, seen_v = latent.surface.motion
    columns = np.stack([np.ones(len(seen_d)), seen_d, seen_v], axis=1)
    weights = np.linalg.lstsq(columns, force(seen_d, seen_v), rcond=None)[0]
    return force(d, v) - (weights[0] + weights[1] * d + weights[2] * v)


def total(run: NonlinearRun) -> FloatArray:
    """Force of the strut over time, less its mean, which no accelerometer sees."""
    m = run.model.mechanics
    force = m.stiffness[1] * run.deflection[:, 1] + m.damping[1] * run.rate[:, 1] + run.force[:, 0]
    return force - force.mean()


@pytest.mark.parametrize("name", ["quadratic stiffness", "position-dependent damping"])
def test_the_force_is_the_one_that_was_put_in(name: str) -> None:
    truth, latent, run = found(name, rounds=2)
    d, v = truth.deflection[:, 1], truth.rate[:, 1]
    left = total(run) - total(truth)
    settled = slice(200, None)  # a load that shifts the mean makes the body settle first
    assert np.std(left[settled]) < 0.2 * np.std(without_linear(latent, d, v, TRUTHS[name]))
    assert latent.log_evidence > 50


@pytest.mark.slow
def test_the_band_holds_the_truth_as_often_as_it_says() -> None:
    run = NonlinearSimulator(MECHANICS, RATE).run(road(1), [])
    d, v = run.deflection[:, 1], run.rate[:, 1]
    surface, respond = Surface.over(d, v), respond_of(run.model)
    jacobian = respond(np.stack([d, v], axis=1))
    force = TRUTHS["position-dependent damping"](d, v)
    signal = respond(force[:, None])[:, 0]
    expected = None
    rng = np.random.default_rng(5)
    inside = []
    for _ in range(8):
        residual = signal + rng.standard_normal(len(signal))
        latent = estimate_force(surface, (d, v), respond, residual, jacobian)
        if expected is None:
            expected = without_linear(latent, d, v, TRUTHS["position-dependent damping"])
        inside.append(np.mean(np.abs(latent.force(d, v) - expected) < 2 * latent.std(d, v)))
    assert 0.88 < np.mean(inside) < 0.995


def test_the_surface_as_a_law_explains_a_recording_that_it_never_saw() -> None:
    name = "position-dependent damping"
    _, latent, fitted = found(name, rounds=2)
    fresh = road(7)
    simulator = NonlinearSimulator(MECHANICS, RATE)
    measured = simulator.run(fresh, [Placement(hidden(name, TRUTHS[name]), (1,), (1.0,))]).outputs
    k, c = fitted.model.mechanics.stiffness, fitted.model.mechanics.damping
    before = simulator.run(fresh, [], stiffness=k, damping=c).outputs - measured
    placed = [Placement(latent.law(), (1,), (1.0,))]
    after = simulator.run(fresh, placed, stiffness=k, damping=c).outputs - measured
    assert (np.std(after, axis=0) < 0.3 * np.std(before, axis=0)).all()


def test_nothing_is_found_where_nothing_is() -> None:
    _, latent, _ = found("nothing", rounds=1)
    d, v = latent.surface.motion
    assert latent.log_evidence < 3
    assert np.abs(latent.force(d, v)).mean() < 2 * latent.std(d, v).mean()


def test_the_surface_leaves_spring_and_damper_alone() -> None:
    _, latent, _ = found("quadratic stiffness", rounds=1)
    d, v = latent.surface.motion
    force = latent.force(d, v)
    for column in (np.ones(len(d)), d, v):
        share = (force @ column) / np.sqrt((force @ force) * (column @ column))
        assert abs(share) < 1e-6


def test_a_map_for_drawing() -> None:
    _, latent, _ = found("quadratic stiffness", rounds=1)
    drawn = latent.map((21, 15))
    assert drawn.force.shape == drawn.std.shape == (15, 21)
    assert (drawn.std > 0).all()


def test_splines_are_a_partition_of_one_and_reproduce_lines() -> None:
    axis = Axis(2.0, 6)
    x = np.linspace(-2, 2, 101)
    basis = axis.basis(x)
    np.testing.assert_allclose(basis.sum(axis=1), 1.0, atol=1e-12)
    centres = (np.arange(axis.count) - 1) * (4 / 6) - 2
    np.testing.assert_allclose(basis @ centres, x, atol=1e-9)
    np.testing.assert_allclose(axis.basis(np.array([5.0])), axis.basis(np.array([2.0])))
