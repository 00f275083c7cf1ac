"""A clearance told as stops beside no spring, and stops of a soft spring, which are no clearance."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.search.restated import restated
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws import SpringDamper, find_law
from sprung.model.laws.along import force_along
from sprung.model.laws.base import ElementLaw
from tests.diagnosis_cases import STIFFNESS, quarter_car, simulate

GAP = 4e-4
K = STIFFNESS["secondary"]
SOFT = 0.25  # of the spring, left before the stops of a soft one


def _clearance(d: float, v: float) -> float:
    return -K * min(max(d, -GAP), GAP)


def _soft_with_stops(d: float, v: float) -> float:
    return (SOFT - 1) * K * d + K * (d - min(max(d, -GAP), GAP))


def _told_as_stop(law: Callable[[float, float], float], left: float) -> Investigation:
    """An investigation that has found stops where a law acts, with this share of the spring beside them at first."""
    state = begun(quarter_car(), simulate(law, seconds=10, seed=4), Options(), lambda share, text: None)
    term = Term(find_law("bump_stop"), "secondary", (GAP, K), scales=(GAP, K))
    candidate = Candidate(term, 1.0, ELEMENT)
    start = start_of(state.fit, candidate)
    theta = start.theta.copy()
    theta[[p.name for p in state.system.parameters].index("secondary.stiffness")] = np.log(left)
    fit = optimise(state.problem, replace(start, theta=theta), 10)
    reduction = state.fit.chi_square - fit.chi_square
    trial = Trial(candidate, fit, reduction, reduction, reduction, 2)
    return replace(state, fit=fit, found=(AcceptedFinding(trial, (), None, 0.0),))


@pytest.mark.slow
def test_stops_that_have_no_spring_between_them_are_told_as_its_clearance() -> None:
    before = _told_as_stop(_clearance, 0.02)
    after = restated(before)
    (term,), (found,) = after.fit.point.terms, after.found
    sigma = float(np.sqrt(after.fit.covariance[after.fit.place(0), after.fit.place(0)][0, 0]))
    assert term.law.name == found.trial.term.law.name == "clearance"
    assert abs(term.parameters[0] - GAP) < 4 * sigma
    assert float(after.fit.forward.element_at("secondary").stiffness) == pytest.approx(K, rel=0.03)
    (rival,) = found.trials  # what it was called before, beaten by what one parameter and the lost spring cost
    assert rival is before.found[0].trial and rival.evidence < found.trial.evidence - 6


def test_stops_of_a_soft_spring_stay_stops() -> None:
    before = _told_as_stop(_soft_with_stops, SOFT)
    after = restated(before)
    assert after.fit is before.fit
    (found,) = after.found
    assert found.trial is before.found[0].trial
    assert [(rival.term.law.name, rival.evidence < found.trial.evidence - 6) for rival in found.trials] == [
        ("clearance", True)
    ]


def test_a_spring_near_nominal_is_told_in_no_other_words(monkeypatch: pytest.MonkeyPatch) -> None:
    def refit(*anything: Any) -> None:
        raise AssertionError

    state = _told_as_stop(lambda d, v: K * (d - min(max(d, -GAP), GAP)), 1.0)
    monkeypatch.setattr("sprung.model.diagnosis.investigation.search.restated.try_optimise", refit)
    assert restated(state) is state


@pytest.mark.parametrize("parameters", [(GAP, 2 * K), (GAP, 2 * K, GAP, 2 * K)])
def test_the_other_words_are_the_same_curve_where_there_is_no_spring(parameters: tuple[float, ...]) -> None:
    law = find_law("bump_stop")
    assert isinstance(law, ElementLaw) and law.wider is not None
    law = law if len(parameters) == len(law.parameters) else law.wider
    d = np.linspace(-3 * GAP, 3 * GAP, 101)
    element, rest = SpringDamper(0.0, 10.0), np.zeros_like(d)
    assert law.restated is not None
    (other,) = law.restated(parameters, element)
    told = force_along(other.law, other.parameters, d, rest, rest, other.element) + other.element.stiffness * d
    np.testing.assert_allclose(told, force_along(law, parameters, d, rest, rest, element), atol=1e-9 * K)
