"""Where fits of a candidate begin where the nominal structure was driven far off its nominal values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection import starts
from sprung.model.laws import find_law

PROBLEM: Any = SimpleNamespace(rules=RULES)


def fitted(theta: list[float]) -> Any:
    return SimpleNamespace(point=SimpleNamespace(theta=np.array(theta)))


@pytest.mark.parametrize(
    ("theta", "law", "nominal"),
    [
        ([0.4, -0.3], "coulomb_friction", [False]),
        ([-2.5, 3.1], "coulomb_friction", [False, True]),  # friction that was taken for a damper 22 times as strong
        ([-2.5, 3.1], "series_stiffness", [False]),  # has no strength that it could begin with there
    ],
)
def test_a_law_also_starts_from_nominal_values_where_the_present_ones_are_far_off(
    theta: list[float], law: str, nominal: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(starts, "joint_start", lambda p, b, h, nominal=False: asked.append(nominal))
    monkeypatch.setattr(starts, "_further_starts", lambda *anything: [])
    found = find_law(law)
    candidate: Any = SimpleNamespace(start=None, term=Term(found, "strut", (1.0,) * len(found.parameters)))
    starts.starts_of(PROBLEM, fitted(theta), candidate)
    assert asked == nominal
