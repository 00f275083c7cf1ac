"""Every deciding number has a reason and a range that it stands in; a variation changes it alone."""

from __future__ import annotations

from dataclasses import fields

import pytest

from sprung.model.diagnosis.rules import RULES


@pytest.mark.parametrize(("stage", "name"), [(stage, one.name) for stage, one in RULES.constants()])
def test_a_number_says_why_it_is_what_it_is(stage: str, name: str) -> None:
    one = next(f for f in fields(getattr(RULES, stage)) if f.name == name)
    low, high = one.metadata["range"]
    assert low <= one.default <= high and low < high
    assert ("derived" in one.metadata["reason"]) != ("chosen" in one.metadata["reason"])
    varied = RULES.varied(stage, name, high)
    assert getattr(getattr(varied, stage), name) == high
    assert varied.varied(stage, name, one.default) == RULES
