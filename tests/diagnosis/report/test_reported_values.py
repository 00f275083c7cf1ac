"""Values of laws with deviations and units, as they are reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.report.values import deviations, law_parameters
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import Motion, SpringDamper, find_law, observe
from sprung.model.laws.basis import SMALL, static_law
from tests.diagnosis_cases import quarter_car


@pytest.mark.parametrize(("law", "unit"), [("sensor_bias", "m/s^2"), ("sensor_gain", "1"), ("sensor_lag", "s")])
def test_an_offset_is_reported_in_the_unit_of_its_channel(law: str, unit: str) -> None:
    term = Term(find_law(law), "car_a", (0.9,))
    fit: Any = SimpleNamespace(
        point=SimpleNamespace(terms=(term,)),
        place=lambda index: slice(0, 1),
        covariance=np.eye(1),
        forward=SimpleNamespace(system=quarter_car()),
    )
    parameters = law_parameters(fit, 0)
    assert [one.unit for one in parameters] == [unit]


def test_a_size_in_the_unit_of_a_power_is_as_uncertain_as_the_power() -> None:
    """beta in m^-n of a hysteresis that yields over 5 mm: its exponent is simulated to a thousandth."""
    term = Term(find_law("bouc_wen"), "secondary", (9.2e4, 2.0e4, 2.0))
    along = np.array([0.0, 2.0e4 * np.log(1 / 0.005), 1.0])  # of one more in the exponent
    fit: Any = SimpleNamespace(
        point=SimpleNamespace(terms=(term,)),
        place=lambda index: slice(0, 3),
        covariance=np.outer(along, along) * 1e-8 + np.diag([1.0, 1.0, 1e-14]),
        forward=SimpleNamespace(system=quarter_car()),
    )
    values = {one.name: one for one in law_parameters(fit, 0)}
    assert values["n"].std == pytest.approx(2e-3, rel=0.05)
    assert values["beta"].std == pytest.approx(2.0e4 * np.log(1 / 0.005) * 2e-3, rel=0.05)


def test_what_branches_stand_for_is_reported_as_accurately_as_they_follow_it() -> None:
    term = Term(find_law("structural_damping"), "primary|secondary", (0.04, 0.0), scales=(0.02, 0.1))
    fit: Any = SimpleNamespace(
        point=SimpleNamespace(terms=(term,)),
        place=lambda index: slice(0, 2),
        covariance=np.diag([1e-10, 1e-10]),
        forward=SimpleNamespace(system=quarter_car()),
    )
    loss, power = law_parameters(fit, 0)
    assert loss.std == pytest.approx(4e-4, rel=0.02)  # dense branches lose 0.7 to 1.3 % more than seven
    assert power.std == pytest.approx(0.02, rel=0.01)


DEFLECTION = 0.01 * np.sin(2 * np.pi * np.arange(4000) / 400)  # m, at 1 Hz
RATE = 0.01 * 2 * np.pi * np.cos(2 * np.pi * np.arange(4000) / 400)


def fit_with(term: Term) -> Any:
    """A quarter car whose secondary carries a law along a sine."""
    system, element = quarter_car(), SpringDamper(2e4, 1.5e3)
    force = term.element_law.force(Motion(DEFLECTION, RATE, 0.0), term.parameters, element)
    count = len(system.parameters)
    return SimpleNamespace(
        point=SimpleNamespace(terms=(term,), theta=np.zeros(count)),
        covariance=1e-6 * np.eye(count + len(term.parameters)),
        forces=SimpleNamespace(
            terms=[term], deflection=DEFLECTION[:, None], rate=RATE[:, None], force=np.asarray(force)[:, None]
        ),
        forward=SimpleNamespace(
            element_of=lambda term: element,
            part=SimpleNamespace(grid=SimpleNamespace(start=0.0, fine_time=np.arange(4000) / 400)),
        ),
    )


def log_deviation(fit: Any, quantity: str, reported: int | None = None) -> float:
    system = quarter_car()
    at = [parameter.name for parameter in system.parameters].index(f"secondary.{quantity}")
    return float(deviations(system, fit, reported)[at])


def test_beside_a_stop_that_is_not_reported_a_spring_may_be_as_stiff_as_it_is_beyond_the_gap() -> None:
    gap, stop = 0.005, 5e4
    fit = fit_with(Term(find_law("bump_stop"), "secondary", (gap, stop)))
    nominal = next(p.nominal for p in quarter_car().parameters if p.name == "secondary.stiffness")
    beyond = np.mean(np.abs(DEFLECTION) > gap)
    assert log_deviation(fit, "stiffness") == pytest.approx(1e-3)
    assert log_deviation(fit, "stiffness", reported=0) == pytest.approx(stop * np.sqrt(beyond) / nominal, rel=0.02)


def test_a_spring_is_as_uncertain_as_the_slopes_of_an_unnamed_force_beside_it() -> None:
    """A square of the deflection has no slope on average, but one to either side."""
    law = static_law(SMALL["d^2"], observe(DEFLECTION, RATE, 400.0, 2e4, 1.5e3))
    fit = fit_with(Term(law, "secondary", (50.0,)))
    nominal = next(p.nominal for p in quarter_car().parameters if p.name == "secondary.stiffness")
    slopes = 2 * 50.0 / law.scale_d**2 * DEFLECTION
    assert log_deviation(fit, "stiffness") == pytest.approx(np.sqrt(np.mean(slopes**2)) / nominal, rel=0.02)
