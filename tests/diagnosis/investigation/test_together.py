"""Several laws of one strut, which alone explain much less than together."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation import minor
from sprung.model.diagnosis.investigation.named_laws import with_named_laws
from sprung.model.laws import find_law
from sprung.model.laws.formula import formula_law


def _found(law: object) -> Any:
    named = getattr(law, "named", False)
    return SimpleNamespace(trial=SimpleNamespace(named=named, term=SimpleNamespace(law=law)))


SURFACE, FORMULA = _found(None), _found(formula_law("a * d * abs(v)", "", ("a",)))
VALVE_AND_STOP = tuple(_found(find_law(name)) for name in ("damper_blowoff", "bump_stop"))


@dataclass(frozen=True)
class _Stand:
    """What `by_names` reads of an investigation: a fit that leaves `left` times the noise."""

    left: float
    found: tuple[Any, ...] = ()
    refuted: bool = False
    options: Options = field(default_factory=Options)
    bounded: bool = False

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
    ("formula", "names", "bounded", "taken"),
    [(1.0, 1.0, False, False), (4.0, 1.3, False, True), (4.0, 1.3, True, False), (4.0, 4.1, False, False)],
)
def test_a_formula_that_leaves_more_than_noise_makes_way_for_names_that_leave_less(
    formula: float, names: float, bounded: bool, taken: bool
) -> None:
    def search(state: Any) -> Any:
        return state if state.found else _Stand(names, VALVE_AND_STOP, options=state.options, bounded=bounded)

    told: Any = _Stand(formula, (FORMULA,))
    chosen: Any = with_named_laws(_Stand(400.0), told, search, lambda share, text: None)  # type: ignore[arg-type]
    assert (chosen.found == VALVE_AND_STOP) is taken


@pytest.mark.parametrize(
    ("reduction", "noisy", "counts"), [(90.0, True, True), (90.0, False, False), (40.0, True, False)]
)
def test_a_small_second_law_counts_where_it_explains_most_of_what_is_no_noise(
    reduction: float, noisy: bool, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(minor, "leaves_more_than_noise", lambda state: noisy)
    state: Any = SimpleNamespace(options=Options(), fit=SimpleNamespace(chi_square=100.0))
    found: Any = SimpleNamespace(reduction=reduction)
    assert minor._explains_most_of_the_rest(state, found) is counts
