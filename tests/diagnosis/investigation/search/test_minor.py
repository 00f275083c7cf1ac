"""What a further finding may be beside those that there are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sprung.model.diagnosis.investigation.search.minor import _absorbed
from sprung.model.laws import CATALOGUE
from sprung.model.laws.formula import formula_law
from sprung.model.system import load_system

LAWS: dict[str, Any] = {law.name: law for law in CATALOGUE} | {"formula": formula_law("a * d**2", "", ("a",))}


def trial(law: str, location: str, gain: float) -> Any:
    return SimpleNamespace(term=SimpleNamespace(law=LAWS[law], location=location), gain=gain)


def after(*found: Any) -> Any:
    return SimpleNamespace(system=load_system(), found=[SimpleNamespace(trial=one) for one in found])


@pytest.mark.parametrize(
    ("law", "location", "gain", "taken"),
    [
        ("suspended_mass", "car", 50.0, True),
        ("missing_connection", "car|bogie2", 50.0, True),
        ("flexible_mode", "car", 50.0, True),
        ("suspended_mass", "car", 5000.0, False),  # explains more than the force did
        ("suspended_mass", "bogie2", 50.0, False),  # another body
        ("coulomb_friction", "secondary_2l", 50.0, False),
    ],
)
def test_parts_of_the_bodies_that_an_unlisted_force_pulls_take_up_what_it_leaves(
    law: str, location: str, gain: float, taken: bool
) -> None:
    assert _absorbed(after(trial("formula", "secondary_1l", 900.0)), trial(law, location, gain)) is taken
    assert not _absorbed(after(trial("coulomb_friction", "secondary_1l", 900.0)), trial(law, location, gain))
