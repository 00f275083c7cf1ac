"""Which screened candidates are fitted: along a motion far from the measured one, scores tell the place alone."""

import pytest

from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT
from sprung.model.diagnosis.screening.score import Candidate, Screening
from sprung.model.diagnosis.selection.compete import shortlist
from sprung.model.laws import find_law

SCORES = {
    ("storey", "cubic_stiffness"): 9e4,
    ("storey", "air_spring"): 3e4,
    ("storey", "bouc_wen"): 4e3,
    ("roof", "bouc_wen"): 5e3,
}


@pytest.mark.parametrize("gross", [True, False])
def test_all_laws_of_the_leading_element_are_fitted_where_little_is_explained(gross: bool) -> None:
    candidates = [
        Candidate(Term(law := find_law(name), at, law.absent), s, ELEMENT) for (at, name), s in SCORES.items()
    ]
    chosen = shortlist(Screening(tuple(candidates), {ELEMENT: 100}), alpha=1e-3, gross=gross)
    plain = [("storey", "cubic_stiffness"), ("storey", "air_spring")]
    assert [(one.location, one.effect) for one in chosen] == plain + [("storey", "bouc_wen")] * gross


def test_what_would_be_significant_on_the_whole_recording_is_fitted() -> None:
    law = find_law("cubic_stiffness")
    scores = {"one": 19.0, "two": 26.0, "three": 12.0}
    candidates = tuple(Candidate(Term(law, at, law.absent), s, ELEMENT) for at, s in scores.items())
    screening = Screening(candidates, {ELEMENT: 100})
    assert [one.location for one in shortlist(screening, alpha=1e-4)] == ["two"]
    assert {one.location for one in shortlist(screening, alpha=1e-4, whole=1 / 0.7)} == {"one", "two"}
