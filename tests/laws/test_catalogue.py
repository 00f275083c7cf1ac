"""One contract for every law of the catalogue, and closed forms for each."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.laws import (
    CATALOGUE,
    ElementLaw,
    Law,
    Observed,
    SpringDamper,
    find_law,
    observe,
)
from sprung.model.laws.motion import CLOCK_LEAD, Motion
from sprung.model.laws.stiffness import CLEARANCE
from sprung.model.laws.trajectory import along, phi
from sprung.model.signals import FloatArray
from tests.named_laws import element_law, support_law, wider_law

SPRING = SpringDamper(4.3e5, 2.0e4)
RATE = 1000.0
LAWS = tuple(law for law in CATALOGUE if isinstance(law, ElementLaw))
ids = [law.name for law in LAWS]
ONE_SIDED = {
    "damper_asymmetry",
    "progressive_stop",
    "gas_spring",
    "preload",
}  # whose force backwards is not the opposite
FEEDING = {"time_varying_stiffness"}  # a spring that stiffens while it is compressed gives more than it took


def cycle(
    amplitude: float = 0.004, frequency: float = 1.25, seconds: float = 8.0, rate: float = RATE
) -> tuple[FloatArray, FloatArray, float]:
    """A sine with whole periods: deflection, velocity, angular frequency."""
    t = np.arange(int(seconds * rate)) / rate
    omega = 2 * np.pi * frequency
    return amplitude * np.sin(omega * t), amplitude * omega * np.cos(omega * t), omega


def seen() -> Observed:
    rng = np.random.default_rng(1)
    d = 0.003 * rng.standard_normal(2000)
    return observe(d, 0.05 * rng.standard_normal(2000), 100.0, *SPRING)


def trial(law: ElementLaw) -> FloatArray:
    trials = law.shapes(seen())
    return trials[len(trials) // 2]


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_every_trial_is_admissible_and_finite(law: ElementLaw) -> None:
    trials = law.shapes(seen())
    assert trials.shape[1] == len(law.parameters) and len(trials) >= 1
    assert np.isfinite(trials).all()
    for p in trials:
        assert law.admits(p), (law.name, p)


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_a_batch_of_trials_gives_what_each_gives_alone(law: ElementLaw) -> None:
    d, v, _ = cycle(seconds=1.6)
    trials = law.shapes(seen())
    together = along(law, tuple(trials.T[:, :, None]), d, v, sample_rate=RATE, element=SPRING)
    assert together.shape == (len(trials), len(d))
    alone = along(law, tuple(trials[-1]), d, v, sample_rate=RATE, element=SPRING)
    np.testing.assert_allclose(together[-1], alone, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_a_law_vanishes_at_its_absent_values(law: ElementLaw) -> None:
    d, v, _ = cycle(0.02, seconds=1.6)
    absent = np.array(law.absent)
    present = np.abs(along(law, tuple(trial(law)), d, v, sample_rate=RATE, element=SPRING)).max()
    if np.isinf(absent).any():  # vanishes in the limit
        absent = np.where(np.isinf(absent), 1e11, absent)
    force = along(law, tuple(absent), d, v, sample_rate=RATE, element=SPRING)
    assert present > 1.0
    assert np.abs(force).max() < 1e-3 * present


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_the_force_is_linear_in_the_strength_where_the_law_says_so(law: ElementLaw) -> None:
    if law.strength is None:
        pytest.skip("no parameter is a strength")
    d, v, _ = cycle(seconds=1.6)
    p = trial(law)
    one = along(law, tuple(p), d, v, sample_rate=RATE, element=SPRING)
    two = along(law, tuple(law.scaled(tuple(p), 0.5)), d, v, sample_rate=RATE, element=SPRING)
    np.testing.assert_allclose(two, 0.5 * one, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_symmetry_is_as_declared(law: ElementLaw) -> None:
    d, v, _ = cycle(seconds=1.6)
    p = tuple(trial(law))
    there = along(law, p, d, v, sample_rate=RATE, element=SPRING)
    back = along(law, p, -d, -v, sample_rate=RATE, element=SPRING)
    assert np.allclose(back, -there, rtol=1e-9, atol=1e-6) == (law.name not in ONE_SIDED)


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_a_passive_element_creates_no_energy_over_a_cycle(law: ElementLaw) -> None:
    if law.name in FEEDING:
        pytest.skip("feeds energy by nature")
    for amplitude in (0.0005, 0.004, 0.02):
        d, v, _ = cycle(amplitude, seconds=2.4)
        trials = law.shapes(seen()).T[:, :, None]
        total = SPRING.stiffness * d + SPRING.damping * v
        total = total + along(law, tuple(trials), d, v, sample_rate=RATE, element=SPRING)
        last = slice(len(d) - int(0.8 * RATE), None)  # the last whole period, memories settled
        assert (np.sum(total[:, last] * v[last], axis=1) >= 0).all()


@pytest.mark.parametrize("law", LAWS, ids=ids)
def test_the_force_changes_smoothly_with_every_parameter(law: ElementLaw) -> None:
    d, v, _ = cycle(0.02, seconds=1.6)
    p = trial(law)
    base = along(law, tuple(p), d, v, sample_rate=RATE, element=SPRING)
    for i in range(len(p)):
        slopes = []
        for step in (1e-4, 1e-5):
            moved = p.copy()
            moved[i] += step * max(abs(p[i]), 1e-3)
            force = along(law, tuple(moved), d, v, sample_rate=RATE, element=SPRING)
            slopes.append((force - base) / step)
        assert np.isfinite(slopes).all()
        size = np.sqrt(np.mean(slopes[1] ** 2))
        assert size > 0
        assert np.sqrt(np.mean((slopes[1] - slopes[0]) ** 2)) < 0.1 * size


@pytest.mark.parametrize("law", CATALOGUE, ids=[law.name for law in CATALOGUE])
def test_words_are_complete_and_look_alikes_exist(law: Law) -> None:
    names = {other.name for other in CATALOGUE} | {"unknown"}
    assert law.looks_like and law.title
    assert set(law.confused_with) <= names - {law.name}
    law.sentence.format(**{name: "1 N" for name in (*law.names, "all")})
    assert len(law.absent) == len(law.parameters)
    for parameter in law.parameters:
        assert parameter.low < parameter.high and parameter.unit and parameter.meaning


def test_the_contracts_effects_are_all_there_with_parameters_in_its_order() -> None:
    expected = {
        "cubic_stiffness": ("k3",),
        "bump_stop": ("gap", "stiffness"),
        "clearance": ("gap",),
        "coulomb_friction": ("force", "smoothing"),
        "damper_blowoff": ("knee", "ratio"),
        "damper_asymmetry": ("a",),
        "quadratic_damping": ("c2",),
        "series_stiffness": ("ks",),
        "bouc_wen": ("alpha", "beta", "n"),
        "time_varying_stiffness": ("p", "tau"),
        "time_varying_damping": ("p", "tau"),
        "flexible_mode": ("frequency", "damping_ratio"),
        "external_force": ("amplitude", "frequency"),
        "mass_change": ("ratio",),
        "sensor_gain": ("gain",),
        "sensor_lag": ("time",),
        "sensor_bias": ("offset",),
        "sensor_noise": ("ratio",),
        "sensor_stuck": (),
        "sensor_error": (),
    }
    for name, parameters in expected.items():
        assert find_law(name).names[: len(parameters)] == parameters


def test_an_unknown_name_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ValueError, match="coulomb_friction"):
        find_law("colomb")


def test_clearance_leaves_no_spring_force_inside_the_gap_and_full_slope_outside() -> None:
    d = np.linspace(-0.01, 0.01, 2001)
    total = SPRING.stiffness * d + CLEARANCE.force(Motion(d, 0 * d), (0.002,), SPRING)
    assert np.abs(total[np.abs(d) <= 0.002]).max() < 1e-9
    np.testing.assert_allclose(total[d > 0.0021], SPRING.stiffness * (d[d > 0.0021] - 0.002), rtol=1e-9)


def test_friction_dissipates_four_f_a_per_cycle() -> None:
    d, v, _ = cycle(0.004, 1.25, 0.8, rate=100_000.0)
    force = along(element_law("coulomb_friction"), (300.0, 1e-5), d, v, sample_rate=1e5, element=SPRING)
    assert np.sum(force * v) / 1e5 == pytest.approx(4 * 300.0 * 0.004, rel=1e-3)


def test_quadratic_damping_dissipates_its_closed_form() -> None:
    d, v, omega = cycle(0.004, 1.25, 0.8)
    force = along(element_law("quadratic_damping"), (3e5,), d, v, sample_rate=RATE, element=SPRING)
    peak = 0.004 * omega  # 8/3 c2 (A omega)^2 A per cycle
    assert np.sum(force * v) / RATE == pytest.approx(8 / 3 * 3e5 * peak**2 * 0.004, rel=1e-4)


def test_the_cubic_has_three_quarters_of_its_peak_in_the_fundamental() -> None:
    d, v, _ = cycle()
    force = along(element_law("cubic_stiffness"), (1e9,), d, v, sample_rate=RATE, element=SPRING)
    fundamental = 2 * np.mean(force * d) / 0.004  # amplitude of the sine part
    assert fundamental == pytest.approx(0.75 * 1e9 * 0.004**3, rel=1e-9)


def test_bump_stop_stores_half_kb_times_squared_penetration() -> None:
    d = np.linspace(0, 0.01, 100_001)
    force = element_law("bump_stop").force(Motion(d, 0 * d), (0.004, 2e6), SPRING)
    assert np.trapezoid(force, d) == pytest.approx(0.5 * 2e6 * 0.006**2, rel=1e-6)


def test_blow_off_and_asymmetry_have_the_contracts_slopes() -> None:
    v = np.linspace(-0.2, 0.2, 4001)
    c = SPRING.damping
    slope = np.gradient(c * v + element_law("damper_blowoff").force(Motion(0 * v, v), (0.05, 0.3), SPRING), v)
    np.testing.assert_allclose(slope[np.abs(v) < 0.049], c, rtol=1e-6)
    np.testing.assert_allclose(slope[np.abs(v) > 0.051], 0.3 * c, rtol=1e-6)
    slope = np.gradient(c * v + element_law("damper_asymmetry").force(Motion(0 * v, v), (-0.31,), SPRING), v)
    np.testing.assert_allclose(slope[v > 1e-3], 0.69 * c, rtol=1e-6)
    np.testing.assert_allclose(slope[v < -1e-3], 1.31 * c, rtol=1e-6)


@pytest.mark.parametrize("name, branch", [("series_stiffness", True), ("air_spring", False)])
def test_branches_have_the_frequency_response_of_a_maxwell_element(name: str, branch: bool) -> None:
    d, v, omega = cycle(frequency=5.0)
    ks, c = 1.2e6, SPRING.damping
    p = (ks,) if branch else (ks, c / ks)
    force = along(element_law(name), p, d, v, sample_rate=RATE, element=SPRING)
    if branch:
        force = force + c * v
    last = slice(len(d) - 1000, None)
    phasor = 2 * np.mean(force[last] * (d[last] * omega + 1j * v[last])) / (0.004 * omega)  # in-phase + 1j quadrature
    expected = 1j * omega * c / (1 + 1j * omega * c / ks) * 0.004
    np.testing.assert_allclose(phasor, expected, rtol=1e-5)


def test_bouc_wen_saturates_at_its_yield_deflection() -> None:
    t = np.arange(2000) / 1e3
    d, v = 0.01 * t, np.full_like(t, 0.01)
    beta, alpha = 700.0, 9e4
    force = along(element_law("bouc_wen"), (alpha, beta, 1.0), d, v, sample_rate=1e3, element=SPRING)
    expected = alpha / (1.5 * beta) * (1 - np.exp(-1.5 * beta * d))  # z' = v (1 - 1.5 beta z) for v > 0
    np.testing.assert_allclose(force, expected, rtol=1e-8, atol=1e-8)


def test_drift_starts_before_the_recording() -> None:
    d, v, _ = cycle()
    force = along(element_law("time_varying_stiffness"), (0.2, 16.0), d, v, sample_rate=RATE, element=SPRING)
    t = np.arange(len(d)) / RATE + CLOCK_LEAD
    np.testing.assert_allclose(force, SPRING.stiffness * 0.2 * (1 - np.exp(-t / 16.0)) * d, rtol=1e-9, atol=1e-6)


def test_a_dip_has_its_depth_and_its_rate_is_the_slope() -> None:
    law = support_law("wheel_flat")
    t = np.arange(20_000) / 20_000
    moved, rate = law.movement(t, (1e-3, 4.0, 0.2))
    assert t[np.argmin(moved)] == pytest.approx(0.05, abs=1e-3)
    np.testing.assert_allclose(rate[1:-1], np.gradient(moved, t)[1:-1], atol=2e-5)
    both = 1e-3 * law.displacements(t, 4.0, np.array([0.7, 0.2]), highest=13.0)
    np.testing.assert_allclose(both[1], law.movement(t, (1e-3, 4.0, 0.2), highest=13.0)[0], atol=1e-12)


def test_phi_functions_are_accurate_where_series_and_recursion_meet() -> None:
    x = -np.logspace(-8, 3, 400)
    e, one, two, three = phi(x)
    np.testing.assert_allclose(x * one + 1, e, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(x * two + 1, one, rtol=1e-12)
    np.testing.assert_allclose(x * three + 0.5, two, rtol=1e-12)
    assert phi(np.array(-1e-9))[3] == pytest.approx(1 / 6, rel=1e-8)


def test_valves_of_a_damper_that_is_harder_in_one_direction_keep_their_forces_ratio() -> None:
    a, knee, ratio, v = 0.3, 0.05, 0.25, np.linspace(-0.2, 0.2, 4001)
    valves = element_law("damper_blowoff").force(Motion(0 * v, v), (knee, ratio), SPRING)
    harder = wider_law("damper_asymmetry").force(Motion(0 * v, v), (a, knee, ratio), SPRING)
    one_way = SPRING.damping * np.where(np.abs(v) < knee, v, np.sign(v) * knee + ratio * (v - np.sign(v) * knee))
    np.testing.assert_allclose(SPRING.damping * v + valves + harder, (1 + a * np.sign(v)) * one_way, atol=1e-9)


def test_stops_of_either_side_have_gaps_and_stiffnesses_of_their_own() -> None:
    d = np.array([-0.03, -0.02, -0.01, 0.0, 0.01, 0.02])
    force = wider_law("bump_stop").force(Motion(d, 0 * d), (0.015, 2e5, 0.02, 3e5), SPRING)
    np.testing.assert_allclose(force, [-3e3, 0.0, 0.0, 0.0, 0.0, 1e3], atol=1e-9)
