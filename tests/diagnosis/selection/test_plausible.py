"""What is not named as physics, however well it fits."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.selection.plausible import (
    displaced_spring,
    doubt,
    excitation_lines,
    hardly_there,
    harmonic,
    hum,
    out_of_range,
)
from sprung.model.laws import find_law
from tests.diagnosis_cases import quarter_car

GRID = Grid(4000, 0.01)


@dataclass
class Excited:
    """One support and one force over time, as a part of a recording has them."""

    displacement: np.ndarray
    pushed: np.ndarray
    grid: Grid = GRID
    support: np.ndarray = field(init=False)
    force: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.support, self.force = (GRID.forward(x[:, None]) for x in (self.displacement, self.pushed))


def sine(frequency: float) -> np.ndarray:
    return np.sin(2 * np.pi * frequency * GRID.time)


def periodic(frequency: float) -> Term:
    return Term(find_law("external_force"), "mass", (100.0, frequency, 0.0), "z")


@pytest.mark.parametrize("where", ["support", "force"])
def test_a_multiple_of_the_excitation_is_no_force_of_its_own(where: str) -> None:
    still = np.zeros(GRID.samples)
    part: Any = Excited(sine(1.05), still) if where == "support" else Excited(still, sine(1.05))
    assert excitation_lines(part) == [pytest.approx(1.05, abs=0.02)]
    for multiple in (1, 3, 5):
        assert "excitation" in (harmonic(part, periodic(multiple * 1.05)) or "")
    assert harmonic(part, periodic(3.7)) is None


def test_a_broad_excitation_has_no_harmonics() -> None:
    road = np.random.default_rng(1).standard_normal(GRID.samples)
    part: Any = Excited(np.cumsum(road), road)
    assert excitation_lines(part) == []
    assert harmonic(part, periodic(3.15)) is None


@pytest.mark.parametrize(
    ("frequency", "mains"), [(50.02, True), (59.95, True), (100.1, True), (25.0, False), (48.7, False), (0.1, False)]
)
def test_a_force_at_the_frequency_of_the_mains_may_be_hum_of_the_instruments(frequency: float, mains: bool) -> None:
    part: Any = Excited(np.zeros(GRID.samples), np.zeros(GRID.samples))
    assert ("mains" in (hum(part, periodic(frequency)) or "")) is mains


@pytest.mark.parametrize("law", ["suspended_mass", "flexible_mode"])
def test_a_resonance_above_what_is_compared_is_no_resonance(law: str) -> None:
    fit: Any = SimpleNamespace(forward=SimpleNamespace(part=SimpleNamespace(grid=GRID), system=quarter_car()))
    found = find_law(law)
    highest = GRID.omega[GRID.band][-1] / (2 * np.pi)
    for factor, believed in ((0.9, True), (1.1, False)):
        values = [0.1] * len(found.parameters)
        values[found.names.index("frequency")] = factor * highest
        term = Term(found, "floor", tuple(values), "z")
        assert (doubt(fit, term) is None) == believed


@pytest.mark.parametrize(
    ("law", "values", "believed"),
    [
        ("sensor_gain", (0.9,), True),
        ("sensor_gain", (6.5,), False),
        ("mass_change", (1.3,), True),
        ("mass_change", (2.7,), False),
    ],
)
def test_gains_and_masses_that_stand_for_something_else_are_not_accepted(
    law: str, values: tuple[float, ...], believed: bool
) -> None:
    reason = out_of_range(Term(find_law(law), "x", values))
    assert (reason is None) == believed


@pytest.mark.parametrize(
    ("law", "values", "deviation", "hardly"),
    [
        ("sensor_gain", (1.0006,), 1e-5, True),  # a simulation is no better than a thousandth
        ("sensor_gain", (1.008,), 1e-5, False),
        ("mass_change", (1.02,), 0.01, True),
        ("sensor_bias", (0.02,), 0.001, False),
        ("series_stiffness", (1e12,), 5e14, True),  # as good as rigid
        ("series_stiffness", (1e7,), 1e6, False),
        ("coulomb_friction", (20.0, 0.01), 5.0, False),  # one of its values is determined
        ("coulomb_friction", (20.0, 0.01), 30.0, True),  # none is
    ],
)
def test_what_is_as_if_it_were_not_there_is_no_finding(
    law: str, values: tuple[float, ...], deviation: float, hardly: bool
) -> None:
    count = len(values)
    point = SimpleNamespace(theta=np.zeros(1), terms=(Term(find_law(law), "x", values),))
    fit: Any = SimpleNamespace(covariance=np.diag([1.0, *[deviation**2] * count]), point=point)
    fit.place = lambda index: slice(1, 1 + count)
    assert hardly_there(fit) == hardly


@pytest.mark.parametrize(("knee", "believed"), [(0.2, True), (0.004, False)])
def test_a_knee_within_one_sample_is_not_accepted(knee: float, believed: bool) -> None:
    rate = np.repeat(0.5 * sine(2.0), 4)  # passes 0.06 m/s within a sample at its reversals
    term = Term(find_law("damper_blowoff"), "strut", (knee, 0.2))
    part = SimpleNamespace(grid=GRID)
    system = SimpleNamespace(elements=("strut",))
    fit: Any = SimpleNamespace(
        element_motion=(rate[:, None], rate[:, None]), forward=SimpleNamespace(part=part, system=system)
    )
    reason = doubt(fit, term)
    assert (reason is None) == believed
    assert believed or "within a sample" in (reason or "")


def test_what_is_damped_as_strongly_as_a_damper_is_no_elastic_mode() -> None:
    fit: Any = SimpleNamespace(forward=SimpleNamespace(part=SimpleNamespace(grid=GRID), system=quarter_car()))
    law = find_law("flexible_mode")
    for ratio, believed in ((0.05, True), (0.46, False)):
        assert (doubt(fit, Term(law, "floor", (3.0, ratio, 0.3), "z")) is None) == believed


@pytest.mark.parametrize(
    ("law", "was", "now", "doubted"),
    [
        ("air_spring", 0.8, 0.12, True),  # takes the place of the spring that it stands beside
        ("air_spring", 0.8, 0.4, False),
        ("missing_connection", 1.0, 7.0, True),
        ("air_spring", 0.1, 0.12, False),  # the file's value was no guide in the first place
        ("bouc_wen", 0.8, 0.01, False),  # what slips may be all that there is
    ],
)
def test_a_linear_part_leaves_a_spring_its_load(law: str, was: float, now: float, doubted: bool) -> None:
    spring = SimpleNamespace(name="strut.stiffness", quantity="stiffness")
    damper = SimpleNamespace(name="strut.damping", quantity="damping")
    forward = SimpleNamespace(system=SimpleNamespace(parameters=(spring, damper)))
    before: Any = SimpleNamespace(point=SimpleNamespace(theta=np.log([was, 1.0])))
    fit: Any = SimpleNamespace(forward=forward, point=SimpleNamespace(theta=np.log([now, 0.01])))
    found = find_law(law)
    reason = displaced_spring(before, fit, Term(found, "strut", found.absent))
    assert (reason is not None) == doubted


@pytest.mark.parametrize(("frequency", "doubted"), [(0.3, True), (6.0, False)])
def test_no_body_bends_far_below_its_motion_on_springs(frequency: float, doubted: bool) -> None:
    """The slowest mode of the quarter car is at 1 Hz: above 0.3 Hz such a mode makes the body lighter, and no more."""
    fit: Any = SimpleNamespace(forward=SimpleNamespace(part=SimpleNamespace(grid=GRID), system=quarter_car()))
    fit.forward.part.grid = SimpleNamespace(omega=GRID.omega, band=GRID.omega < 2 * np.pi * 30)
    law = find_law("flexible_mode")
    values = tuple(frequency if name == "frequency" else 0.05 for name in law.names)
    assert (doubt(fit, Term(law, "car", values)) is not None) == doubted


@pytest.mark.parametrize(("exponent", "doubted"), [(0.1, True), (0.14, True), (0.2, False), (0.9, False)])
def test_a_fluid_damper_whose_force_hardly_grows_with_the_rate_is_friction(exponent: float, doubted: bool) -> None:
    law = find_law("power_law_damping")
    term = Term(law, "strut", (30.0, exponent, 1e-5), scales=(30.0, 0.5, 1e-5))
    reason = out_of_range(term)
    assert (reason is not None) is doubted
    assert reason is None or reason.startswith(f"exponent {exponent:g} lies outside 0.15")
