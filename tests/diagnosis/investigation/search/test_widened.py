"""Laws in their wider forms: where two of one damper act on each other, and not where they are a mere sum."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.search import widened
from sprung.model.diagnosis.investigation.search.widened import (
    best_wider,
    form_covariance,
    share_an_element,
    with_wider_tried,
)
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws import find_law
from tests.diagnosis_cases import DAMPING, quarter_car, simulate

A, KNEE, RATIO = 0.3, 0.04, 0.3


def _damped(together: bool) -> Callable[[float, float], float]:
    """A damper with valves that is harder in extension, less its nominal force: one thing, or a sum of two forces."""

    def force(d: float, v: float) -> float:
        valves = np.clip(v, -KNEE, KNEE) + RATIO * (v - np.clip(v, -KNEE, KNEE))
        return DAMPING["secondary"] * (valves - v + A * np.abs(valves if together else v))

    return force


@pytest.mark.parametrize("together", [True, False])
def test_an_asymmetry_takes_part_in_the_valves_where_it_does(together: bool) -> None:
    state = begun(quarter_car(), simulate(_damped(together), seconds=8, seed=3), Options(), lambda share, text: None)
    fit = state.fit
    for name, values in (("damper_blowoff", (KNEE, RATIO)), ("damper_asymmetry", (A,))):
        candidate: Any = SimpleNamespace(term=Term(find_law(name), "secondary", values, scales=tuple(map(abs, values))))
        fit = optimise(state.problem, start_of(fit, candidate), 6)
    found: Any = tuple(SimpleNamespace(trial=SimpleNamespace(term=term), trials=()) for term in fit.point.terms)
    state = replace(state, fit=fit, found=found)
    assert share_an_element(state)
    state = with_wider_tried(state)
    wide = best_wider(state)
    assert with_wider_tried(state) is state  # made once
    assert wide is not None and (wide.evidence > 20 if together else wide.evidence < 0)
    if together:
        term, place = wide.fit.point.terms[wide.index], wide.fit.place(wide.index)
        sigma = np.sqrt(np.diag(wide.fit.covariance)[place])
        assert term.law.name == "damper_asymmetry"
        assert np.all(np.abs(np.array(term.parameters) - (A, KNEE, RATIO)) < 4 * sigma)


def test_what_a_wider_form_says_otherwise_is_left_open_by_its_odds(monkeypatch: pytest.MonkeyPatch) -> None:
    fit: Any = SimpleNamespace(covariance=np.zeros((2, 2)), point=_point([0.1], (0.2,), 0.0))
    other: Any = SimpleNamespace(point=_point([0.1], (0.3, 1.0), 12.0))
    wide: Any = SimpleNamespace(evidence=-12.0, index=0, fit=other, instead=None)
    monkeypatch.setattr(widened, "share_an_element", lambda state: True)
    monkeypatch.setattr(widened, "with_wider_tried", lambda state: state)
    monkeypatch.setattr(widened, "best_wider", lambda state: wide)
    state: Any = SimpleNamespace(fit=fit, problem=SimpleNamespace(rules=RULES))
    np.testing.assert_allclose(form_covariance(state), [[0.0, 0.0], [0.0, 0.25 * 0.1**2]])
    wide.instead = object()  # parameters of another law are no other values of these
    assert np.all(form_covariance(state) == 0)
    wide.instead, wide.evidence = None, -60.0
    assert np.all(form_covariance(state) < 1e-12)


def _point(theta: Sequence[float], parameters: Sequence[float], prior_cost: float) -> Any:
    terms = (SimpleNamespace(parameters=parameters, law=SimpleNamespace(prior_cost=prior_cost)),)
    return SimpleNamespace(theta=np.array(theta), terms=terms)
