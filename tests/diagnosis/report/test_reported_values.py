"""Values of laws with deviations and units, as they are reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.report.values import law_parameters
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
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
