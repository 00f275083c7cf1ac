"""Candidates of different families beside each other, and where laws may be."""

import pytest

from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening import families
from sprung.model.diagnosis.screening.families import (
    ELEMENT,
    FORCE,
    HARMONIC,
    INPUT,
    LINE,
    SENSOR,
    UNNAMED,
    Family,
)
from sprung.model.diagnosis.screening.places import level_pairs, places, wheelsets
from sprung.model.diagnosis.screening.score import Candidate, Screening
from sprung.model.laws import find_law
from sprung.model.system import load_system
from tests.diagnosis_cases import quarter_car
from tests.named_laws import element_law

FAMILIES = [value for value in vars(families).values() if isinstance(value, Family)]


def candidate(score: float, family: Family, law: str = "cubic_stiffness", count: int = 1) -> Candidate:
    return Candidate(Term(find_law(law), "secondary", (1.0,) * count), score, family)


def test_families_have_names_of_their_own() -> None:
    assert len({family.name for family in FAMILIES}) == len(FAMILIES)


def test_faults_of_inputs_come_before_what_is_simulated_from_them() -> None:
    assert INPUT.rank == FORCE.rank < min(f.rank for f in FAMILIES if f not in (INPUT, FORCE))


@pytest.mark.parametrize(("family", "count", "freedom"), [(ELEMENT, 2, 1), (UNNAMED, 5, 5), (LINE, 3, 2)])
def test_freedom_of_a_score_is_its_familys(family: Family, count: int, freedom: int) -> None:
    assert candidate(9.0, family, count=count).freedom == freedom


def test_searched_frequencies_make_a_score_count_for_less() -> None:
    assert candidate(40.0, HARMONIC).strength() < candidate(40.0, SENSOR).strength()


def test_chances_are_multiplied_by_what_was_tried() -> None:
    one = candidate(20.0, ELEMENT)
    screening = Screening((one,), {ELEMENT: 50, SENSOR: 10}, of_laws=0.5)
    assert screening.p_value(one) == pytest.approx(one.p_single * 100)
    assert screening.tried(SENSOR) == 20


def test_laws_at_elements_have_a_share_of_the_chance_and_the_other_families_equal_ones() -> None:
    families = {ELEMENT: 60, SENSOR: 10, LINE: 30}
    screening = Screening((), families, of_laws=0.6)
    assert [screening.tried(family) for family in families] == [100, 50, 150]
    spent = sum(tests / screening.tried(family) for family, tests in families.items())
    assert spent == pytest.approx(1.0)  # Bonferroni's inequality: the chances of all families add up to the whole
    assert Screening((), {SENSOR: 10, LINE: 30}).tried(LINE) == 60


def test_an_anti_roll_bar_goes_between_left_and_right_and_nothing_is_a_pair_on_a_quarter_car() -> None:
    bar = element_law("anti_roll_bar")
    assert "secondary_1l|secondary_1r" in places(load_system(), bar)
    assert places(quarter_car(), bar) == []
    assert wheelsets(quarter_car()) == []
    assert len(wheelsets(load_system())) == 4
    assert level_pairs(quarter_car(), ["primary", "secondary"]) == []
