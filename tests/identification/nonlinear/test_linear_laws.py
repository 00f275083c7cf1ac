"""Windows of vehicles whose file has laws at bodies and of the structure: part of the mechanics, and tracked."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.identifier import UnusableWindow
from sprung.model.schema import SystemFileError
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, parse_system
from tests.strut import road

FILE = """
name: half-car
sample_rate: 100
window: 200
bodies:
  frame: {mass: 6000, pitch_inertia: 18000, position: [0, 0.8], laws: [LAW]}
  front: {mass: 450, position: [2.2, 0.8]}
  rear: {mass: 600, position: [-1.8, 0.8]}
inputs:
  road_front: {kind: support, displacement: {csv: a, noise: 1.0e-5}, velocity: {csv: b, noise: 5.0e-4}}
  road_rear: {kind: support, displacement: {csv: c, noise: 1.0e-5}, velocity: {csv: d, noise: 5.0e-4}}
elements:
  tyre_front: {upper: front, lower: road_front, position: [2.2, 0.8], stiffness: 9.0e+5, damping: 1500}
  tyre_rear: {upper: rear, lower: road_rear, position: [-1.8, 0.8], stiffness: 1.2e+6, damping: 2000}
  spring_front: {upper: frame, lower: front, position: [2.2, 0.8], stiffness: 1.8e+5, damping: 11000FRICTION}
  spring_rear: {upper: frame, lower: rear, position: [-1.8, 0.8], stiffness: 2.4e+5, damping: 14000}
sensors:
  frame_front: {kind: acceleration, body: frame, position: [2.6, 0.8], csv: e, noise: 0.004}
  frame_rear: {kind: acceleration, body: frame, position: [-2.4, 0.8], csv: f, noise: 0.004}
  axle_front: {kind: acceleration, body: front, csv: g, noise: 0.03}
  axle_rear: {kind: acceleration, body: rear, csv: h, noise: 0.03}
"""
LAWS = {
    "missing_connection": "missing_connection: {with: rear, stiffness: 2.0e+5, damping: 3000, x: 0.5, y: 0.8}",
    "suspended_mass": "suspended_mass: {mass: 500, frequency: 8, damping_ratio: 0.06, x: 1.0, y: 0.8}",
    "flexible_mode": "flexible_mode: {frequency: 9, damping_ratio: 0.03, participation: 0.4, variant: bending}",
    "mass_change": "mass_change: {ratio: 1.2}",
}
FRICTION = ", laws: [coulomb_friction: {force: 300, smoothing: {value: 0.01, fixed: true}}]"


def half_car(law: str, friction: str = "") -> System:
    return parse_system(FILE.replace("LAW", law).replace("FRICTION", friction))


def rides(system: System, seconds: float = 22.0) -> np.ndarray:
    """Windows of the system on two roads, with all noises."""
    rng, time = np.random.default_rng(4), np.arange(int(seconds * 100)) / 100
    columns = []
    for seed in (1, 2):
        _, u = road(seconds + 1, seed)
        columns += [3 * u(time), 3 * u.derivative()(time)]
    inputs = np.column_stack(columns)
    ride = simulate_ride(system, inputs, noise=rng)
    noisy = inputs + rng.standard_normal(inputs.shape) * [1e-5, 5e-4, 1e-5, 5e-4]
    values = np.column_stack([noisy, ride.sensors])
    return np.stack([values[i : i + 200] for i in range(200, len(values) - 199, 100)])


@pytest.mark.parametrize(
    ("name", "friction"),
    [*((name, "") for name in LAWS), ("missing_connection", FRICTION), ("suspended_mass", FRICTION)],
)
def test_values_of_a_linear_law_are_found_beside_springs_with_calibrated_deviations(name: str, friction: str) -> None:
    vehicle = half_car(LAWS[name], friction)
    estimates = load_identifier(vehicle).identify(rides(vehicle))
    own = [i for i, p in enumerate(vehicle.tracked) if name in p.quantity]
    assert own
    # friction is simulated without an anti-alias filter here: some windows do not settle
    assert np.mean([e.adequate for e in estimates]) > (0.7 if friction else 0.9)
    std = np.array([np.sqrt(np.diag(e.covariance)) for e in estimates if e.adequate])
    errors = np.array([e.log_ratio for e in estimates if e.adequate]) / std
    told = np.array([e.identifiable for e in estimates if e.adequate])
    assert told[:, own].mean() > 0.5
    assert np.mean(np.abs(errors[told]) < 1.96) > 0.88


def test_a_law_that_is_left_out_is_a_misfit_and_one_that_moved_is_followed() -> None:
    true = half_car(LAWS["suspended_mass"])
    windows = rides(half_car(LAWS["suspended_mass"].replace("frequency: 8", "frequency: 7.2")))
    without = Identifier(parse_system(FILE.replace(", laws: [LAW]", "").replace("FRICTION", ""))).identify(windows)
    assert np.mean([e.adequate for e in without]) < 0.3
    at = [p.name for p in true.tracked].index("frame.suspended_mass.frequency")
    found = [e for e in load_identifier(true).identify(windows) if e.adequate and e.identifiable[at]]
    weight = np.array([1 / e.covariance[at, at] for e in found])
    mean = float(np.average([e.log_ratio[at] for e in found], weights=weight))
    assert mean == pytest.approx(np.log(7.2 / 8), abs=4 / np.sqrt(weight.sum()) + 0.003)


def test_a_variant_that_a_law_does_not_have_is_told_when_the_file_is_read() -> None:
    with pytest.raises(SystemFileError, match="frame: flexible_mode has no variant 'yaw'; it has bending"):
        half_car(LAWS["flexible_mode"].replace("bending", "yaw"))


def test_what_no_window_can_hold_is_refused_by_name() -> None:
    system = parse_system(
        FILE.replace(", laws: [LAW]", "")
        .replace("FRICTION", "")
        .replace(
            "noise: 5.0e-4}}\n  road_rear",
            "noise: 5.0e-4}, laws: [wheel_flat: {depth: 1.0e-3, frequency: 3, phase: 0.1}]}\n  road_rear",
        )
    )
    with pytest.raises(UnusableWindow, match="road_front: windows cannot be identified with wheel_flat"):
        load_identifier(system).identify(np.zeros((1, 200, 8)))
