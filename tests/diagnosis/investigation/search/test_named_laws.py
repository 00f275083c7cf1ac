"""Several laws of one strut, which alone explain much less than together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.search import minor, named_laws
from sprung.model.diagnosis.investigation.search.named_laws import with_laws_together, with_named_laws
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from sprung.model.laws.formula import formula_law


def _found(law: object) -> Any:
    named = getattr(law, "named", False)
    return SimpleNamespace(trial=SimpleNamespace(named=named, term=SimpleNamespace(law=law, element_law=law)))


SURFACE = _found(SimpleNamespace(named=False, of_formula=False))
FORMULA = _found(formula_law("a * d * abs(v)", "", ("a",)))
VALVE_AND_STOP = tuple(_found(find_law(name)) for name in ("damper_blowoff", "bump_stop"))


@dataclass(frozen=True)
class _Stand:
    """What `by_names` reads of an investigation: a fit that leaves `left` times the noise."""

    left: float
    found: tuple[Any, ...] = ()
    refuted: bool = False
    options: Options = field(default_factory=Options)
    bounded: bool = False
    tried: Any = None

    @property
    def fit(self) -> Any:
        def whitener(spectrum: np.ndarray, part: object) -> np.ndarray:
            return spectrum

        spectrum = np.full(1000, np.sqrt(self.left))
        return SimpleNamespace(
            whitener=whitener, spectrum=spectrum, count=1000, jacobian=np.zeros((1000, 10)), bounded=self.bounded
        )

    @property
    def problem(self) -> Any:
        return SimpleNamespace(process_noise=False, part=None, rules=self.options.rules)

    @property
    def held(self) -> Any:
        return SimpleNamespace(still=False, compare=lambda one, other: SimpleNamespace(refuted=self.refuted))


@pytest.mark.parametrize(("left", "refuted", "taken"), [(1.0, False, True), (1.0, True, False), (10.0, False, False)])
def test_laws_with_names_stand_where_they_leave_next_to_nothing(left: float, refuted: bool, taken: bool) -> None:
    asked: list[bool] = []

    def search(state: Any) -> Any:
        asked.append(state.options.unnamed)
        return _Stand(left, VALVE_AND_STOP, options=state.options)

    unnamed: Any = _Stand(1.0, (SURFACE,), refuted)
    chosen: Any = with_named_laws(_Stand(40.0), unnamed, search, lambda share, text: None)  # type: ignore[arg-type]
    assert asked == [False]
    assert (chosen.found == VALVE_AND_STOP) is taken
    assert chosen.options.unnamed


@pytest.mark.parametrize(
    ("formula", "names", "bounded", "evidence", "taken"),
    [
        (1.0, 1.0, False, 5.0, True),
        (1.0, 1.0, False, -5.0, False),
        (1.0, 1.0, True, 5.0, False),
        (4.0, 1.3, False, 5.0, True),
        (4.0, 1.3, True, 5.0, False),
        (4.0, 4.1, False, 5.0, False),
    ],
)
def test_a_formula_makes_way_for_names_that_leave_less_or_where_both_leave_noise_have_more_evidence(
    formula: float, names: float, bounded: bool, evidence: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def search(state: Any) -> Any:
        return state if state.found else _Stand(names, VALVE_AND_STOP, options=state.options, bounded=bounded)

    monkeypatch.setattr(named_laws, "_evidence", lambda before, unnamed, named: evidence)
    told: Any = _Stand(formula, (FORMULA,))
    chosen: Any = with_named_laws(_Stand(400.0), told, search, lambda share, text: None)  # type: ignore[arg-type]
    assert (chosen.found == VALVE_AND_STOP) is taken


def test_no_names_are_sought_in_place_of_a_single_shape_that_leaves_noise() -> None:
    def search(state: Any) -> Any:
        raise AssertionError

    single = _found(replace(formula_law("a * d * abs(v)", "", ("a",)), strength=0))
    told: Any = _Stand(1.0, (single,))
    assert with_named_laws(_Stand(400.0), told, search, lambda share, text: None) is told  # type: ignore[arg-type]


@pytest.mark.parametrize(("left", "names", "taken"), [(4.0, 1.0, True), (4.0, 3.0, False), (1.0, 1.0, False)])
def test_a_law_that_leaves_more_than_noise_makes_way_for_laws_that_together_leave_noise(
    left: float, names: float, taken: bool
) -> None:
    def search(state: Any) -> Any:
        assert not state.options.unnamed
        return _Stand(names, VALVE_AND_STOP, options=state.options)

    spring: Any = _Stand(left, (_found(find_law("cubic_stiffness")),))
    chosen: Any = with_laws_together(spring, search)
    assert (chosen.found == VALVE_AND_STOP) is taken
    assert chosen.options.unnamed


@pytest.mark.parametrize(
    ("strength", "reduction", "unnamed", "is_one"),
    [
        (30.0, 60.0, True, False),
        (100.0, 60.0, True, False),
        (100.0, 40.0, True, True),
        (100.0, 40.0, False, False),
        (200.0, 60.0, True, True),
        (200.0, 60.0, False, True),
    ],
)
def test_a_small_law_beside_another_is_minor_unless_it_explains_most_of_what_is_no_noise_or_all_are_judged_together(
    strength: float, reduction: float, unnamed: bool, is_one: bool
) -> None:
    term = Term(find_law("cubic_stiffness"), "spring", (strength,), scales=(1.0,))
    fit = SimpleNamespace(
        chi_square=1100.0,
        count=1010,
        jacobian=np.zeros((1, 10)),
        point=SimpleNamespace(terms=(term,)),
        covariance=np.eye(1),
        place=lambda index: slice(0, 1),
    )
    first: Any = SimpleNamespace(trial=SimpleNamespace(term=term))
    state: Any = SimpleNamespace(options=Options(unnamed=unnamed), fit=fit, given=0, found=(first,))
    second: Any = SimpleNamespace(reduction=reduction)
    assert minor._is_minor_beside(state, 0, second) is is_one


@pytest.mark.parametrize(("gain", "is_one"), [(71.0, True), (90.0, False)])
def test_what_is_small_beside_all_laws_elsewhere_together_is_their_inaccuracy(gain: float, is_one: bool) -> None:
    """A wheel flat of 4 um beside a stop and a clearance, each of which explains 20 000."""

    def trial(gain: float, name: str, place: str) -> Any:
        term = Term(find_law(name), place, tuple(1.0 for _ in find_law(name).parameters))
        return SimpleNamespace(gain=gain, named=True, term=term)

    found = tuple(
        SimpleNamespace(trial=trial(2e4, name, place))
        for name, place in (("bump_stop", "left"), ("clearance", "right"))
    )
    state: Any = SimpleNamespace(options=Options(), problem=SimpleNamespace(process_noise=False), found=found)
    assert minor.is_minor(state, trial(gain, "wheel_flat", "wheel")) is is_one


def test_the_statistic_of_a_stop_with_two_sides_is_that_of_the_weaker_side() -> None:
    narrow: Any = find_law("bump_stop")
    wide = narrow.wider
    term = Term(wide, "spring", (0.005, 4e5, 0.006, 2e5), scales=(1e-3, 1e5, 1e-3, 1e5))
    covariance = np.diag([1e-12, 4e8, 1e-12, 4e8])
    point = SimpleNamespace(terms=(term,))
    fit: Any = SimpleNamespace(point=point, covariance=covariance, place=lambda index: slice(0, 4))
    assert minor._wald_statistic(fit, 0, wide) == pytest.approx(100.0)
    assert minor._wald_statistic(fit, 0, narrow) == pytest.approx(400.0)
