"""A finding that later ones explain as well goes; a linear part that errors of the file explain is none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.search import masses, redundant
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import find_law


@dataclass(frozen=True)
class Sought:
    """What is read of an investigation: the gain of every finding when it was made, and how much it still explains."""

    found: tuple[Any, ...]
    given: int = 0
    fit: Any = None
    options: Options = field(default_factory=Options)


def finding(name: str, gain: float, still: float | None) -> Any:
    return SimpleNamespace(name=name, trial=SimpleNamespace(gain=gain), still=still)


@pytest.fixture(autouse=True)
def refitted(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(state: Any, index: int) -> Any:
        kept = (*state.found[:index], *state.found[index + 1 :])
        return None if state.found[index].still is None else replace(state, found=kept)

    def gain(other: Any, state: Any) -> float:
        (gone,) = [one for one in state.found if one not in other.found]
        return float(gone.still)

    monkeypatch.setattr(redundant, "without", without)
    monkeypatch.setattr(redundant, "_gain", gain)
    monkeypatch.setattr(redundant, "cost", lambda fit, rules, index: 12.0)


@pytest.mark.parametrize(
    ("gain", "still", "stays"),
    [
        (100.0, 50.0, True),
        (100.0, 11.0, False),  # less than it costs
        (1e4, 13.0, False),  # next to nothing of what it explained at first
        (100.0, None, True),  # nothing can be fitted without it
    ],
)
def test_a_finding_stays_while_it_explains_enough_beside_the_last_one(
    gain: float, still: float | None, stays: bool
) -> None:
    assert RULES.acceptance.idle * 1e4 > 13.0
    first, last = finding("first", gain, still), finding("last", 500.0, 0.0)
    kept: Any = redundant.without_redundant(Sought((first, last)))  # type: ignore[arg-type]
    assert [one.name for one in kept.found] == (["first", "last"] if stays else ["last"])


def test_all_that_are_redundant_go_and_the_last_one_is_not_asked() -> None:
    found = tuple(finding(str(number), 100.0, 1.0 if number % 2 else 60.0) for number in range(5))
    kept: Any = redundant.without_redundant(Sought((*found, finding("last", 100.0, 0.0))))  # type: ignore[arg-type]
    assert [one.name for one in kept.found] == ["0", "2", "4", "last"]


@pytest.mark.parametrize(
    ("law", "explained", "imitated"),
    [
        ("missing_connection", 130.0, True),  # more, though every error of the file is charged
        ("missing_connection", 100.0, False),
        ("coulomb_friction", 130.0, False),  # no linear part
        ("mass_change", 130.0, False),  # is such an error itself
    ],
)
def test_a_linear_part_is_none_where_masses_and_instruments_explain_more(
    law: str, explained: float, imitated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = [Term(find_law("mass_change"), body, (1.0,)) for body in ("low", "high")]
    monkeypatch.setattr(masses, "calibration_terms", lambda state: errors)
    monkeypatch.setattr(masses, "gain_together", lambda problem, fit, terms, steps: explained * (len(terms) == 2))
    state: Any = SimpleNamespace(
        calibrations=None, fit=SimpleNamespace(point=SimpleNamespace(terms=())), options=Options(), problem=None
    )
    chosen: Any = SimpleNamespace(term=SimpleNamespace(law=find_law(law)), evidence=101.0)
    assert masses.imitates_errors(state, chosen) is imitated
    state.calibrations = 2
    assert masses.imitates_errors(state, chosen) is False  # they take part already
