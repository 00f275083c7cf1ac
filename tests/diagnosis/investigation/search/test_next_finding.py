"""What one step of a search decides: what is chance, what the rest of the recording refutes, what leads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.search import next_finding
from sprung.model.diagnosis.investigation.search.next_finding import _competition, _is_acceptable, _p_value, _whole
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law

TESTS = 10


def trial(law: str = "coulomb_friction", gain: float = 30.0, evidence: float = 20.0, rank: int = 1) -> Any:
    found = find_law(law)
    term = Term(found, "secondary", tuple(1.0 for _ in found.parameters))
    candidate = SimpleNamespace(
        family=SimpleNamespace(rank=rank), score=gain, freedom=2, term=term, location="secondary"
    )
    return SimpleNamespace(
        candidate=candidate, gain=gain, freedom=2, evidence=evidence, term=term, fit=object(), finished=True, named=True
    )


def state(*, refuted: bool = False, still: bool = False, said: float = 0.0, **options: Any) -> Any:
    """What a step reads of an investigation whose second half was not fitted."""
    compared = SimpleNamespace(refuted=refuted, evidence=said)
    held = SimpleNamespace(still=still, split=500, signals=SimpleNamespace(samples=1000), compare=lambda *_: compared)
    fit = object()
    chosen = Options(**options)
    return SimpleNamespace(
        options=chosen,
        held=held,
        fit=fit,
        problem=SimpleNamespace(process_noise=False),
        last=SimpleNamespace(tried=lambda family: TESTS),
        tried=None,
        refutes=lambda fit: chosen.held_out and not still and refuted,
    )


@pytest.mark.parametrize("gain", [20.0, 30.0])
def test_a_chance_is_that_of_chi_square_for_all_tests_together(gain: float) -> None:
    alone = chi2.sf(gain, 2)
    assert _p_value(state(held_out=False), trial(gain=gain)) == pytest.approx(min(1.0, TESTS * alone), rel=1e-6)
    single = state(held_out=False, multiplicity=False)
    assert _p_value(single, trial(gain=gain)) == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize(
    ("gain", "refuted", "accepted"), [(40.0, False, True), (40.0, True, False), (4.0, False, False)]
)
def test_a_finding_is_neither_chance_nor_refuted(gain: float, refuted: bool, accepted: bool) -> None:
    assert _is_acceptable(state(refuted=refuted, said=-10.0), trial(gain=gain)) is accepted


def test_the_rest_of_a_recording_counts_where_it_moves_and_is_asked() -> None:
    assert _whole(state()) == 2.0
    assert _whole(state(still=True)) == 1.0 and _whole(state(held_out=False)) == 1.0


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A competition whose fits are given: `doubted` are implausible, `absent` hardly there, `minor` too small."""
    asked: dict[str, Any] = {"trials": [], "doubted": (), "absent": (), "minor": ()}
    fits = SimpleNamespace(of=lambda fit: next(t for t in asked["trials"] if t.fit is fit))
    monkeypatch.setattr(next_finding, "compete", lambda problem, fit, candidates, *rest: asked["trials"])
    monkeypatch.setattr(next_finding, "with_wider_rivals", lambda state, fitted: fitted)
    monkeypatch.setattr(
        next_finding,
        "doubt",
        lambda fit, term, rules, before: "too stiff" if fits.of(fit) in asked["doubted"] else None,
    )
    monkeypatch.setattr(next_finding, "hardly_there", lambda fit, rules: fits.of(fit) in asked["absent"])
    monkeypatch.setattr(next_finding, "is_minor", lambda state, t: t in asked["minor"])
    monkeypatch.setattr(
        next_finding, "preferred", lambda found, rules: sorted(found, key=lambda t: t.evidence, reverse=True)
    )
    return asked


def compete(asked: dict[str, Any]) -> Any:
    candidates: Any = [one.candidate for one in asked["trials"]]
    return _competition(state(), candidates, lambda text: None)


def test_faults_of_inputs_lead_though_a_law_has_more_evidence(plain: dict[str, Any]) -> None:
    law, fault = trial(evidence=50.0, rank=1), trial("sensor_gain", evidence=20.0, rank=0)
    plain["trials"] = [law, fault]
    assert compete(plain).leading == [fault, law]


def test_what_is_implausible_better_than_all_is_told_and_does_not_lead(plain: dict[str, Any]) -> None:
    best, worse, good = trial(evidence=50.0), trial(evidence=10.0), trial(evidence=20.0)
    plain["trials"], plain["doubted"] = [best, good, worse], (best, worse)
    found = compete(plain)
    assert found.leading == [good] and found.implausible == [(best, "too stiff")]


def test_without_evidence_or_hardly_there_or_minor_nothing_is_a_finding(plain: dict[str, Any]) -> None:
    none, absent, minor = trial(evidence=-1.0), trial(evidence=20.0), trial(evidence=30.0)
    plain["trials"], plain["absent"], plain["minor"] = [none, absent, minor], (absent,), (minor,)
    found = compete(plain)
    assert found.findings == found.leading == [] and found.plausible == plain["trials"]
    assert compete({**plain, "trials": []}).tried == []


def test_what_leads_of_two_competitions_stays_and_only_better_doubts_with_it(plain: dict[str, Any]) -> None:
    first, second, poor, rich = (trial(evidence=e) for e in (20.0, 15.0, 18.0, 30.0))
    plain["trials"] = [first]
    one = compete(plain)
    plain["trials"], plain["doubted"] = [rich, poor, second], (rich, poor)
    both = one.before(compete(plain))
    assert both.leading == [first, second] and [t for t, _ in both.implausible] == [rich]
    assert np.array_equal([t.evidence for t in both.tried], [20.0, 30.0, 18.0, 15.0])
