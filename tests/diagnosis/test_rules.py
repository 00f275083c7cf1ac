"""Every deciding number has a reason and a range that it stands in; a variation changes it alone."""

from __future__ import annotations

from dataclasses import fields

import pytest

from sprung.model.diagnosis.rules import RULES, reason


@pytest.mark.parametrize(("stage", "name"), [(stage, one.name) for stage, one in RULES.constants()])
def test_a_number_says_why_it_is_what_it_is(stage: str, name: str) -> None:
    one = next(f for f in fields(getattr(RULES, stage)) if f.name == name)
    low, high = one.metadata["range"]
    assert low <= one.default <= high and low < high
    assert ("derived" in one.metadata["reason"]) != ("chosen" in one.metadata["reason"])
    assert (
        "insensitive from" in reason(stage, one)
        or "changes at" in reason(stage, one)
        or "not varied" in reason(stage, one)
    )
    varied = RULES.varied(stage, name, high)
    assert getattr(getattr(varied, stage), name) == high
    assert varied.varied(stage, name, one.default) == RULES


def test_what_was_varied_are_numbers_of_the_rules() -> None:
    """A number that was changed or added since says so; few may."""
    reasons = [reason(stage, one) for stage, one in RULES.constants()]
    assert sum("insensitive from" in one or "changes at" in one for one in reasons) > 0.9 * len(reasons)
