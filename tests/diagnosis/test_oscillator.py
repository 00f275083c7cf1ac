"""A lightly damped mass under a measured force: far from its nominal values, with stops, freely decaying."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.jacobian import Linearised, linearise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import along_measured_motion
from sprung.model.diagnosis.record.signals import Signals, declared_noise, transform
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord

SYSTEM = """
name: oscillator
sample_rate: 400
window: 400
bodies:
  mass: {mass: 1.5}
inputs:
  shaker: {kind: force, body: mass, csv: force}
elements:
  spring: {upper: mass, lower: ground, stiffness: 2.5e+4, damping: 10.0}
sensors:
  position: {kind: displacement, body: mass, csv: position, noise: 1.0e-6}
"""
STIFFNESS, DAMPING, MASS, RATE, FINE = 3e4, 8.0, 1.5, 400, 20


def simulate(
    law: Callable[[float, float, float], float],
    memory: Callable[[float, float, float], float] = lambda d, v, z: 0.0,
    *,
    seconds: float = 20.0,
    level: float = 20.0,
    start: float = 0.0,
) -> MadeRecord:
    """Columns force and position; `law(d, v, z)` adds a force to the spring, `memory(d, v, z)` is the rate of its z.

    Random phases up to 60 Hz, Runge-Kutta.
    """
    rng = np.random.default_rng(7)
    samples, step = int(seconds * RATE), 1 / (RATE * FINE)
    lines = np.zeros(samples * FINE // 2 + 1, dtype=complex)
    band = slice(int(2 * seconds), int(60 * seconds))
    lines[band] = np.exp(2j * np.pi * rng.random(band.stop - band.start))
    force = np.fft.irfft(lines, samples * FINE)
    force *= level / np.std(force)  # none at level 0

    def slope(x: float, v: float, z: float, u: float) -> tuple[float, float, float]:
        return v, (u - DAMPING * v - STIFFNESS * x - law(x, v, z)) / MASS, memory(x, v, z)

    rows, x, v, z = np.empty((samples, 2)), start, 0.0, 0.0
    for i in range(samples * FINE):
        if i % FINE == 0:
            rows[i // FINE] = force[i], x
        u = force[i], (force[i] + force[(i + 1) % len(force)]) / 2, force[(i + 1) % len(force)]
        a = slope(x, v, z, u[0])
        b = slope(x + step / 2 * a[0], v + step / 2 * a[1], z + step / 2 * a[2], u[1])
        c = slope(x + step / 2 * b[0], v + step / 2 * b[1], z + step / 2 * b[2], u[1])
        d = slope(x + step * c[0], v + step * c[1], z + step * c[2], u[2])
        x += step / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        v += step / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        z += step / 6 * (a[2] + 2 * b[2] + 2 * c[2] + d[2])
    noise = np.array([1e-3 * max(level, 1.0), 1e-6])
    return MadeRecord(values=rows + noise * rng.standard_normal(rows.shape), sample_rate=float(RATE))


def signals_of(record: MadeRecord) -> Signals:
    return Signals(
        sample_rate=record.sample_rate,
        displacement=np.zeros((len(record.values), 0)),
        velocity=np.zeros((len(record.values), 0)),
        force=record.values[:, :1],
        sensors=record.values[:, 1:],
        sensor_index=np.array([0]),
        sensor_names=("position",),
        support_names=(),
        force_names=("shaker",),
        integrated=np.zeros(0, dtype=bool),
        accelerated=np.zeros(0, dtype=bool),
    )


@pytest.fixture(scope="module")
def linear() -> MadeRecord:
    return simulate(lambda d, v, z: 0.0, seconds=12.0)


def test_values_far_from_nominal_are_found_although_the_resonance_is_narrow(linear: MadeRecord) -> None:
    """20 % of stiffness are ten widths of the resonance: a free run from nominal sees no direction to go."""
    signals, system = signals_of(linear), parse_system(SYSTEM)
    problem, fit = baseline(system, signals, declared_noise(system, signals), 3360)
    found = np.array([p.nominal for p in system.parameters]) * np.exp(fit.point.theta)
    deviations = (np.log(found / [STIFFNESS, DAMPING])) / np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(found, [STIFFNESS, DAMPING], rtol=2e-3)
    assert np.abs(deviations).max() < 4
    assert problem.noise.force[0] == pytest.approx(0.02, rel=0.3)


def test_slopes_of_the_log_determinant_agree_with_finite_differences(linear: MadeRecord) -> None:
    system, signals = parse_system(SYSTEM), signals_of(linear)
    noise = replace(declared_noise(system, signals), force=np.array([2.0]))
    problem = Problem(system, transform(signals, noise), signals.sensor_index, noise)

    def linearised(theta: np.ndarray) -> Linearised:
        return linearise(problem, *along_measured_motion(problem, Point(theta, (), np.zeros(2))))

    here = np.array([0.1, -0.1])
    slopes = linearised(here).log_det_slope
    for i, unit in enumerate(np.eye(2)):
        up, down = (linearised(here + sign * 1e-4 * unit).log_det for sign in (1, -1))
        assert slopes[i] == pytest.approx((up - down) / 2e-4, rel=1e-4)


@pytest.mark.parametrize(
    ("effect", "place", "within"),
    [("sensor_gain", "position", 1e-3), ("sensor_gain", "shaker", 1e-3), ("mass_change", "mass", 0.05)],
)
def test_gradients_by_gains_and_masses_beside_an_unmeasured_force_agree_with_finite_differences(
    linear: MadeRecord, effect: str, place: str, within: float
) -> None:
    """The residual's covariance depends on them, too: else they would be pulled from their values."""
    system, signals = parse_system(SYSTEM), signals_of(linear)
    noise = replace(declared_noise(system, signals), force=np.array([2.0]))
    problem = Problem(system, transform(signals, noise), signals.sensor_index, noise)

    def at(value: float) -> Linearised:
        term = Term(find_law(effect), place, (value,), scales=(0.01,))
        return linearise(problem, *along_measured_motion(problem, Point(np.array([0.1, -0.1]), (term,), np.zeros(2))))

    def objective(lin: Linearised) -> float:
        return float(lin.residual @ lin.residual + lin.log_det)

    here = at(1.03)
    slope = float(here.log_det_slope[2] - 2 * (here.jacobian.T @ here.residual)[2])
    difference = (objective(at(1.03 + 1e-4)) - objective(at(1.03 - 1e-4))) / 2e-4
    assert slope == pytest.approx(difference, rel=within)


@pytest.mark.slow
def test_hard_stops_of_a_lightly_damped_mass_are_named_with_their_values() -> None:
    gap, stop = 1.2e-3, 2e5
    report = diagnose(
        parse_system(SYSTEM),
        simulate(lambda d, v, z: stop * np.sign(d) * max(abs(d) - gap, 0.0), seconds=6.0),
        Options(),
    )
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("spring", "bump_stop")
    found_gap, found_stop = finding.parameters
    assert found_gap.value == pytest.approx(gap, rel=0.02)
    assert found_stop.value == pytest.approx(stop, rel=0.02)
    values = {p.name: p.value for p in report.augmented}
    assert values["spring.stiffness"] == pytest.approx(STIFFNESS, rel=0.02)
    assert values["spring.damping"] == pytest.approx(DAMPING, rel=0.05)


@pytest.mark.slow
def test_friction_shows_in_a_free_decay_without_any_input() -> None:
    """No excitation: a model with everything scaled down fits ever better, were it not for the determinant."""
    record = simulate(lambda d, v, z: 3.0 * np.tanh(v / 5e-3), seconds=4.0, level=0.0, start=0.01)
    record.values[:, 0] = 0.0
    report = diagnose(parse_system(SYSTEM), record, Options())
    assert report.findings[0].location == "spring"
    assert report.findings[0].effect == "coulomb_friction"
    assert report.findings[0].parameters[0].value == pytest.approx(3.0, rel=0.05)
    assert {f.effect for f in report.findings} == {"coulomb_friction"}
    assert any("no force" in note for note in report.advice)
    assert any("hardly moves" in note for note in report.advice)


@pytest.mark.slow
def test_hysteresis_that_stiffens_while_it_is_loaded_is_of_the_bouc_wen_family() -> None:
    """The loop of the Bouc-Wen benchmark (Noel and Schoukens 2016): gamma -1.375, where the common form has 0.5."""
    alpha, beta, gamma = 2e4, 800.0, -1.375
    report = diagnose(
        parse_system(SYSTEM),
        simulate(
            lambda d, v, z: alpha * z,
            lambda d, v, z: v - beta * (abs(v) * z + gamma * v * abs(z)),
            seconds=8.0,
            level=40.0,
        ),
        Options(),
    )
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("spring", "bouc_wen")
    for parameter, truth in zip(finding.parameters, (alpha, beta, 1.0, gamma), strict=True):
        assert abs(parameter.value - truth) < max(4 * parameter.std, 0.03 * abs(truth)), parameter


@pytest.mark.parametrize("samples", [200, 220, 250])
def test_the_shortest_recordings_with_a_measured_force_are_diagnosed(samples: int) -> None:
    """Their held-out part has fewer bins than a block of the evidence."""
    record = simulate(lambda d, v, z: 1e9 * d**3, seconds=samples / RATE)
    report = diagnose(parse_system(SYSTEM), record, Options())
    assert [(f.location, f.effect) for f in report.findings] == [("spring", "cubic_stiffness")]
