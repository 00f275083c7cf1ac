"""System files: what they give and how they are refused."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from sprung.model.schema import SystemFileError
from sprung.model.system import MANCHESTER, load_system, parse_system

TEXT = MANCHESTER.read_text()

OSCILLATOR = """
name: oscillator
sample_rate: 200
window: 128
bodies:
  mass: {mass: 2.0}
inputs:
  push: {kind: force, body: mass, csv: push, noise: 1e-3}
elements:
  spring: {upper: mass, lower: ground, stiffness: 800.0, damping: 4.0}
sensors:
  position: {kind: displacement, body: mass, csv: x, noise: 1e-5}
estimate: [stiffness, damping, mass]
"""

QUARTER_CAR = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  sprung: {mass: 300.0}
  unsprung: {mass: 40.0}
inputs:
  road: {kind: displacement, displacement: {csv: z, noise: 1e-5}, velocity: {csv: vz, noise: 1e-3}}
elements:
  tyre: {upper: unsprung, lower: road, stiffness: 1.8e5, damping: 100.0}
  strut: {upper: sprung, lower: unsprung, stiffness: 2.0e4, damping: 1500.0}
sensors:
  body: {kind: acceleration, body: sprung, csv: a1, noise: 0.01}
  wheel: {kind: acceleration, body: unsprung, csv: a2, noise: 0.05}
  travel: {kind: deflection, element: strut, csv: travel, noise: 1e-5}
  load: {kind: force, element: strut, csv: load, noise: 1.0}
"""


def test_the_vehicle_has_the_sizes_of_the_paper() -> None:
    system = load_system()
    A, B, C, D = system.mechanics.matrices()
    assert A.shape == (18, 18)
    assert B.shape == (18, 16)
    assert C.shape == (12, 18)
    assert D.shape == (12, 16)
    assert len(system.parameters) == 24
    assert system.parameters[0].name == "primary_11l.stiffness"
    assert system.parameters[-1].name == "secondary_2r.damping"
    assert len(system.channels) == 28
    assert system.hop == 50


def test_modes_of_the_vehicle_are_the_known_ones() -> None:
    system = load_system()
    modes = system.mechanics.modes(system.bodies)
    assert np.allclose(
        [mode.frequency for mode in modes], [0.81, 1.08, 1.31, 7.41, 7.43, 9.17, 9.19, 11.71, 11.71], atol=0.006
    )
    assert [mode.body for mode in modes[:3]] == ["car"] * 3
    assert all("bogie" in mode.body for mode in modes[3:])


def test_damping_ratios_are_those_of_the_undamped_energies() -> None:
    system = load_system()
    A, *_ = system.mechanics.matrices(damping=1e-6 * system.mechanics.damping)
    light = np.sort(np.abs(np.linalg.eigvals(A)))[::2]
    K = (system.mechanics.H.T * system.mechanics.stiffness) @ system.mechanics.H
    undamped = np.sqrt(np.sort(np.linalg.eigvals(K / system.mechanics.mass[:, None]).real))
    assert np.allclose(light, undamped, rtol=1e-5)


def test_matrices_are_linear_in_the_element_values() -> None:
    mechanics = load_system().mechanics
    rng = np.random.default_rng(0)
    k, c = rng.uniform(1, 2, (2, 12)), rng.uniform(1, 2, (2, 12))
    for part in range(4):
        one, two = (mechanics.matrices(k[i], c[i])[part] for i in range(2))
        both = mechanics.matrices(k.sum(axis=0), c.sum(axis=0))[part]
        none = mechanics.matrices(np.zeros(12), np.zeros(12))[part]
        assert np.allclose(one + two - none, both)


def test_a_single_oscillator_has_its_closed_form_mode() -> None:
    system = parse_system(OSCILLATOR)
    (mode,) = system.mechanics.modes(system.bodies)
    assert mode.frequency == pytest.approx(20 / (2 * np.pi))
    assert mode.damping_ratio == pytest.approx(4 / (2 * np.sqrt(800 * 2)))
    assert [p.name for p in system.parameters] == ["spring.stiffness", "spring.damping", "mass.mass"]


def test_addresses_and_comments_do_not_change_the_digest_and_values_do() -> None:
    assert parse_system(TEXT.replace("mcap: /car/", "mcap: /wagon/")).digest == load_system().digest
    assert parse_system(TEXT.replace("mass: 32000", "mass: 32001")).digest != load_system().digest


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "upper: bogie1, lower: wheel_11l",
            "upper: bogi1, lower: wheel_11l",
            r"line 47: elements.primary_11l.upper.*did you mean 'bogie1'",
        ),
        ("mass: 32000", "mass: -32000", r"line 8: bodies.car.mass: .*greater than or equal to 0"),
        ("noise: 0.004, mcap", "noise: 0.004, nois: 1, mcap", r"line 61: sensors.car_1l.nois: unknown key"),
        ("sample_rate: 100 ", "sample_rat: 100 ", r"line \d+: sample_rate: this key is missing"),
        ("name: manchester", "name: b\nname: manchester", r"line 4: name: this key occurs twice"),
        (
            "stiffness: 1.22e+6",
            "stiffness: soft",
            r"line 47: elements.primary_11l.stiffness: a number or a mapping is expected",
        ),
        ("stiffness: 1.22e+6", "stiffness: 0.0", r"primary_11l.stiffness: a nominal value of 0 cannot be estimated"),
        ("name: manchester", "[", r"not YAML"),
        ("estimate: [stiffness, damping]", "estimate: [stiffness, colour]", r"estimate"),
        ("stiffness: 1.22e+6", "stiffness: .inf", r"finite number"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_line_and_key(old: str, new: str, message: str) -> None:
    with pytest.raises(SystemFileError, match=message) as caught:
        parse_system(TEXT.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_sensors_that_miss_a_body_are_refused_by_its_name() -> None:
    blind = re.sub(r"  bogie1_\d[lr]: \{kind.*\n", "", TEXT)
    blind = re.sub(r"  (bogie2_\d[lr]|car_1r|car_2[lr]): \{kind.*\n", "", blind)
    with pytest.raises(SystemFileError, match=r"sensors: no sensor sees the .* Hz mode of"):
        parse_system(blind)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemFileError, match=r"nowhere.yaml: cannot read"):
        load_system(tmp_path / "nowhere.yaml")


def test_a_system_goes_to_another_process() -> None:
    system = load_system()
    copy = pickle.loads(pickle.dumps(system))
    assert copy.digest == system.digest and copy.catalogue is system.catalogue


def test_a_body_that_nothing_holds_is_reported_as_such() -> None:
    """As in a drop test: accelerations do not tell where a free body is."""
    text = """
name: dropped
sample_rate: 100
window: 100
bodies: {body: {mass: 400}, wheel: {mass: 25}}
inputs:
  ground_load: {kind: force, body: wheel, csv: g, noise: 10}
elements:
  oleo: {upper: body, lower: wheel, stiffness: 3.0e+4, damping: 4000}
sensors:
  acc: {kind: acceleration, body: body, csv: a, noise: 0.05}
"""
    with pytest.raises(SystemFileError, match=r"nothing holds body, and no sensor sees where it drifts; .*too soft"):
        parse_system(text)
