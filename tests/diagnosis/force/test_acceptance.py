"""Which law is added to a component's: by errors, evidence and commonness that are put in, without any fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest

from sprung.model.diagnosis.force import acceptance
from sprung.model.diagnosis.force.acceptance import accepted
from sprung.model.diagnosis.force.fit import ComponentModel
from sprung.model.diagnosis.force.lag import LAGS, Lag
from sprung.model.diagnosis.force.parts import Part
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.ranking import Ranked, Step
from sprung.model.diagnosis.rules import RULES

RULE = RULES.component
FLOOR = 1.0  # N
CUBIC, STOP, FRICTION, DAHL = (
    next(piece for piece in PIECES if piece.effect == name and piece.commoner == commoner)
    for name, commoner in (("cubic_stiffness", 0), ("bump_stop", 0), ("coulomb_friction", 0), ("dahl", 1))
)


@dataclass(frozen=True)
class FakeFit:
    """As much of a fit as decides: its errors, N^2, and its laws."""

    error: float
    held_out: float
    pieces: tuple[Part, ...] = ()
    determined: bool = True
    certain: bool = True  # determined with systematic errors, too
    task: Any = field(default_factory=lambda: SimpleNamespace(rules=RULE))
    floor: float = FLOOR

    @property
    def model(self) -> ComponentModel:
        shapes = tuple((1.0,) * len(piece.shapes) for piece in self.pieces)
        return ComponentModel(self.pieces, shapes)

    @property
    def at_noise(self) -> bool:
        return max(self.error, self.held_out) < RULE.at_noise * FLOOR**2

    @property
    def leaves_more(self) -> bool:
        return max(self.error, self.held_out) > RULE.above * FLOOR**2

    def leaves_hardly_more(self, best: FakeFit) -> bool:
        pairs = ((self.error, best.error), (self.held_out, best.held_out))
        return all(here - FLOOR**2 < RULE.hardly_more * (there - FLOOR**2) for here, there in pairs)


@pytest.fixture(autouse=True)
def determined(monkeypatch: pytest.MonkeyPatch) -> None:
    def of(fit: FakeFit, *, by_all: bool = False) -> bool:
        return fit.certain if by_all else fit.determined

    monkeypatch.setattr(acceptance, "is_last_determined", of)


def ranked(piece: Part, left: float, evidence: float, before: tuple[Part, ...] = (), **more: Any) -> Any:
    """A model with one law more that leaves `left`, N^2, of both parts."""
    return Ranked(FakeFit(left, left, (*before, piece), **more), evidence + 20.0, evidence, 1000.0)  # type: ignore[arg-type]


def step(models: list[Any], left: float = 100.0, pieces: tuple[Part, ...] = ()) -> Step | None:
    """What is accepted beside a model with `pieces` that leaves `left`, N^2; the linear one leaves 200."""
    current: Any = Ranked(FakeFit(left, left, pieces), 0.0, 0.0, 1000.0)  # type: ignore[arg-type]
    base: Any = FakeFit(200.0, 200.0)
    return accepted(current, sorted(models, key=lambda one: -one.evidence), base, RULE, tests=100)


def chosen(models: list[Any], **beside: Any) -> Part | None:
    found = step(models, **beside)
    return None if found is None else found.piece


def test_the_law_of_most_evidence_is_accepted_with_the_others_as_its_rivals() -> None:
    found = step([ranked(CUBIC, 1.0, 500.0), ranked(STOP, 30.0, 300.0), ranked(STOP, 40.0, 200.0)])
    assert found is not None and found.piece is CUBIC and found.p_value < RULE.alpha
    assert [rival.last for rival in found.rivals] == [STOP, STOP] and found.forms == ()


def test_of_laws_that_are_as_good_the_commonest_is_accepted_though_another_has_more_evidence() -> None:
    assert chosen([ranked(DAHL, 1.0, 503.0), ranked(FRICTION, 1.02, 500.0)]) is FRICTION
    assert chosen([ranked(DAHL, 1.0, 503.0), ranked(FRICTION, 3.0, 500.0)]) is DAHL  # it predicts better
    assert chosen([ranked(DAHL, 3.0, 503.0), ranked(FRICTION, 3.0, 503.0 - 2 * RULE.naming_margin)]) is DAHL


def test_nothing_is_accepted_that_chance_explains_or_that_predicts_no_better() -> None:
    small = replace(ranked(CUBIC, 99.0, 1.0), gain=5.0)
    assert chosen([small]) is None
    worse = ranked(CUBIC, 1.0, 500.0)
    assert chosen([replace(worse, fit=replace(worse.fit, held_out=101.0))]) is None
    assert chosen([]) is None


def test_a_further_law_has_to_be_determined_and_to_remove_enough() -> None:
    beside = {"pieces": (FRICTION,)}
    enough = 100.0 * (1 - 1.1 * RULE.least_share)
    assert chosen([ranked(CUBIC, enough, 500.0, (FRICTION,))], **beside) is CUBIC
    assert chosen([ranked(CUBIC, 100.0 * (1 - 0.9 * RULE.least_share), 500.0, (FRICTION,))], **beside) is None
    assert chosen([ranked(CUBIC, enough, 500.0, (FRICTION,), determined=False)], **beside) is None


def test_where_all_may_be_noise_the_first_law_has_to_be_certain() -> None:
    noise = 0.9 * RULE.above * FLOOR**2
    assert chosen([ranked(CUBIC, 1.0, 500.0)], left=noise) is CUBIC
    assert chosen([ranked(CUBIC, 1.0, 500.0, certain=False)], left=noise) is None
    assert chosen([ranked(CUBIC, 1.0, 500.0, certain=False)]) is CUBIC  # more than noise is left without it


def test_of_models_that_are_not_exact_a_determined_law_that_leaves_as_little_is_accepted() -> None:
    flexible, certain = ranked(DAHL, 10.0, 500.0, determined=False), ranked(CUBIC, 15.0, 400.0)
    assert chosen([flexible, certain]) is CUBIC
    assert chosen([flexible, ranked(CUBIC, 30.0, 400.0)]) is DAHL  # it leaves much more


@pytest.mark.parametrize("lag", LAGS)
def test_a_late_channel_is_accepted_alone_where_it_explains_nearly_everything(lag: Lag) -> None:
    nearly, partly = FLOOR**2 + 99.0 * 0.9 * (1 - RULE.by_lag), 40.0
    assert chosen([ranked(lag, nearly, 500.0), ranked(CUBIC, 50.0, 300.0)]) is lag
    assert chosen([ranked(lag, partly, 500.0), ranked(CUBIC, 50.0, 300.0)]) is CUBIC  # the lag may be hysteresis


def test_beside_a_law_a_filter_may_be_oil_and_a_delay_counts_where_nothing_is_left() -> None:
    delay, filtered = LAGS
    left = FLOOR**2 + 99.0 * 0.9 * RULE.together
    beside = {"pieces": (FRICTION,)}
    assert chosen([ranked(delay, left, 500.0, (FRICTION,))], **beside) is delay
    assert chosen([ranked(filtered, left, 500.0, (FRICTION,))], **beside) is None
    assert chosen([ranked(delay, 10 * left, 500.0, (FRICTION,))], **beside) is None
