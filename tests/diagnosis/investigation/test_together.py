"""Several laws of one strut, which alone explain much less than together."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation import diagnose
from sprung.model.diagnosis.investigation.by_names import by_names


@dataclass(frozen=True)
class _Stand:
    """What `by_names` reads of an investigation: a fit that leaves `left` times the noise."""

    left: float
    found: tuple[str, ...] = ()
    refuted: bool = False
    options: Options = field(default_factory=Options)

    @property
    def fit(self) -> Any:
        def whitener(spectrum: np.ndarray, part: object) -> np.ndarray:
            return spectrum

        spectrum = np.full(1000, np.sqrt(self.left))
        return SimpleNamespace(whitener=whitener, spectrum=spectrum, count=1000, jacobian=np.zeros((1000, 10)))

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
        return _Stand(left, ("valve", "stop"), options=state.options)

    unnamed: Any = _Stand(1.0, ("surface",), refuted)
    chosen: Any = by_names(_Stand(40.0), unnamed, search)  # type: ignore[arg-type]
    assert asked == [False]
    assert (chosen.found == ("valve", "stop")) is taken
    assert chosen.options.unnamed


@pytest.mark.parametrize(("worth", "noisy", "counts"), [(90.0, True, True), (90.0, False, False), (40.0, True, False)])
def test_a_small_second_law_counts_where_it_explains_most_of_what_is_no_noise(
    worth: float, noisy: bool, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnose, "leaves_more_than_noise", lambda state: noisy)
    state: Any = SimpleNamespace(options=Options(), fit=SimpleNamespace(chi_square=100.0))
    assert diagnose._explains_the_rest(state, SimpleNamespace(worth=worth)) is counts
