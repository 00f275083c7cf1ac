"""Laws in a system file: what is accepted, what is refused and how."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.amortised.estimator import bundled_estimator
from sprung.model.laws import ElementLaw, Motion, SpringDamper
from sprung.model.schema import SystemFileError
from sprung.model.system import System, load_system, parse_system

TEXT = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {mass: 45}
  car: {mass: 400}
inputs:
  road: {kind: displacement, displacement: {csv: road, noise: 1.0e-5}}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 200000, damping: 50}
  strut: {upper: car, lower: wheel, stiffness: 20000, damping: 1500%s}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a, noise: 0.01}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.01%s}
"""


def system(strut: str = "", sensor: str = "") -> System:
    return parse_system(TEXT % (strut, sensor))


def test_laws_are_placed_with_values_and_deviations() -> None:
    (law, bias) = system(
        ", laws: [{coulomb_friction: {force: {value: 30, std: 2}, smoothing: {value: 0.01, fixed: true}}}]",
        ", laws: [{sensor_bias: {offset: 0.1}}]",
    ).laws
    assert (law.location, law.law.name, law.values) == ("strut", "coulomb_friction", (30.0, 0.01))
    assert (law.std, law.fixed) == ((2.0, None), (False, True))
    assert law.names == ("strut.coulomb_friction.force", "strut.coulomb_friction.smoothing")
    assert (bias.location, bias.values) == ("car_a", (0.1,))


def test_a_form_of_a_law_is_asked_for_by_its_variant() -> None:
    (stop,) = system(", laws: [{bump_stop: {gap: 0.02, stiffness: 1.0e5, variant: compression}}]").laws
    assert isinstance(stop.law, ElementLaw) and (stop.law.name, stop.variant) == ("bump_stop", "compression")
    force = stop.law.force(Motion(np.array([-0.03, 0.0, 0.03]), 0.0), stop.values, SpringDamper(2e4, 1500.0))
    np.testing.assert_allclose(force, [-1e3, 0.0, 0.0])
    with pytest.raises(SystemFileError, match="bump_stop has no 'up'; it has extension, compression"):
        system(", laws: [{bump_stop: {gap: 0.02, stiffness: 1.0e5, variant: up}}]")


def test_a_formula_is_a_law() -> None:
    text = ', laws: [{formula: {formula: "a * d**3 + b * z", memory: "v - abs(v) * z / y", a: 1.0e6, b: 100, y: 0.01}}]'
    (law,) = system(text).laws
    assert isinstance(law.law, ElementLaw) and law.law.names == ("a", "b", "y") and law.law.memory == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[{coulomb_frictoin: {force: 1}}]", "did you mean 'coulomb_friction'"),
        ("[{coulomb_friction: {force: 1}}]", "elements.strut.laws.0.coulomb_friction: smoothing is missing"),
        ("[{coulomb_friction: {force: 1, smoothing: 0.1, f: 2}}]", "f is no parameter of it"),
        ("[{coulomb_friction: {force: -1, smoothing: 0.1}}]", "force must lie between 0 and"),
        ("[{sensor_bias: {offset: 1}}]", "does not belong here"),
        ("[{anti_roll_bar: {stiffness: 1}}]", "with: the name of the other one is expected"),
        ("[{anti_roll_bar: {stiffness: 1, with: strut}}]", "with: the name of the other one"),
        ('[{formula: {formula: "a * q", a: 1}}]', "'q' is none of"),
        ('[{formula: {formula: "a * d", a: 1, b: 2}}]', "parameter 'b' is not used"),
        ('[{formula: {formula: "a * z", a: 1}}]', "give its rate as `memory`"),
        ('[{formula: {formula: "c * d**3", c: 1.0e9}}]', "'c' has the name of a variable"),  # the element's damping
        ("[{coulomb_friction: {force: much, smoothing: 0.1}}]", "a number is expected, not 'much'"),
        ("[{bump_stop: {gap: 1, stiffness: 2}, clearance: {gap: 1}}]", "laws"),
    ],
)
def test_a_wrong_law_is_reported_by_its_key(text: str, said: str) -> None:
    with pytest.raises(SystemFileError, match="strut") as told:
        system(f", laws: {text}")
    assert said in str(told.value) and "\n" not in str(told.value)


def test_laws_count_in_the_digest_and_their_deviations_do_not() -> None:
    law = ", laws: [{quadratic_damping: {c2: %s}}]"
    assert system().digest != system(law % "10").digest
    assert system(law % "{value: 10}").digest == system(law % "{value: 10, std: 3}").digest
    assert bundled_estimator(load_system()) is not None  # files without laws keep the digest of their weights


@pytest.mark.parametrize("formula", ["a * d / 0", "a * sqrt(d)", "a * exp(1e9 * abs(d))", "a * 1e300 * d", "a * 0 / d"])
def test_a_formula_that_never_has_a_force_is_refused(formula: str) -> None:
    with pytest.raises(SystemFileError, match=r"laws.0.formula: formula .* no finite force at d = "):
        system(f', laws: [{{formula: {{formula: "{formula}", a: 1.0e+5}}}}]')


@pytest.mark.parametrize(
    "formula", ["a * d**3", "a * (exp(d / 1e-4) - 1)", "a * sign(d) * sqrt(abs(d))", "a * v / 0.1"]
)
def test_a_formula_that_is_finite_in_small_motions_is_taken(formula: str) -> None:
    assert len(system(f', laws: [{{formula: {{formula: "{formula}", a: 1.0e+5}}}}]').laws) == 1


def test_a_memory_without_a_rate_is_refused() -> None:
    with pytest.raises(SystemFileError, match="no finite rate of z"):
        system(', laws: [{formula: {formula: "a * z", memory: "v / 0", a: 1}}]')
