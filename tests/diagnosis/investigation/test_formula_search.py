"""Formulas of an unnamed force: sums of two are found by their scores, halves of them and rivals are doubted."""

from __future__ import annotations

import numpy as np
import pytest
from diagnosis_cases import DAMPING, STIFFNESS, quarter_car, simulate

from sprung.model.diagnosis.investigation.course import Options
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.formula import formula_of
from sprung.model.diagnosis.investigation.formula_doubt import doubt_of, missing, own_size, uncertainty, whole_force
from sprung.model.diagnosis.investigation.formula_search import FormulaSearch, taken_out
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT, UNNAMED
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import compete
from sprung.model.laws.grammar import Factor, Shape, law_of

RATE, STOP, GAP = 2e6, -4e5, 0.002


@pytest.fixture(scope="module")
def unnamed():
    """An investigation that has begun, and its best unnamed force: a spring that stiffens with the rate, and a stop."""
    record = simulate(lambda d, v: RATE * d * abs(v) + STOP * max(-d - GAP, 0.0), seconds=12.0, seed=3)
    state = begun(quarter_car(), record, Options(), lambda share, text: None)
    hits = [hit for hit in state.last.candidates if hit.family is UNNAMED and hit.location == "secondary"]
    return state, compete(state.problem, state.fit, hits)[0]


@pytest.fixture(scope="module")
def searched(unnamed):
    state, trial = unnamed
    return FormulaSearch.along(state.problem, trial.fit).best()


def test_the_residual_without_a_force_is_that_force_and_noise(unnamed):
    state, trial = unnamed
    bare = taken_out(state.problem, trial.fit)
    assert bare.chi_square > 5 * trial.fit.chi_square
    assert bare.jacobian.shape[1] == trial.fit.jacobian.shape[1] - len(trial.term.parameters)
    assert len(bare.point.terms) == len(trial.fit.point.terms) - 1


def test_pairs_hold_both_shapes_of_a_sum_and_say_more_than_any_single_shape(searched):
    singles, pairs = searched
    assert not singles or pairs[0].score > singles[0].score
    told = [set(pair.term.variant.split(" + ")) for pair in pairs]
    assert {"d * abs(v)", "max(-d - L, 0)"} in told, told


@pytest.mark.slow
def test_a_sum_is_told_with_its_force_and_its_half_is_doubted(unnamed, searched):
    state, trial = unnamed
    told, reason = formula_of(state.problem, state.fit, trial, state.held)
    assert told is not None and reason == ""
    d, v = ((part @ told.term.port(state.system))[::OVERSAMPLING] for part in told.fit.element_motion)
    truth = (
        STIFFNESS["secondary"] * d + DAMPING["secondary"] * v + RATE * d * np.abs(v) + STOP * np.maximum(-d - GAP, 0)
    )
    size = own_size(told.fit)
    assert np.std(whole_force(told.fit) - truth) < 0.07 * size
    assert missing(state.problem, told.fit) < 0.05 and uncertainty(state.problem, told.fit) < 0.1 * size
    half = law_of((Shape(Factor("d", 1), Factor("abs(v)", 1, -1)),))
    (alone,) = compete(
        state.problem, state.fit, [Candidate(Term(half, "secondary", (RATE,), scales=(RATE,)), 1.0, ELEMENT)]
    )
    assert "follows the element's motion" in doubt_of(state.problem, alone, [alone])
    assert np.std(whole_force(told.fit) - whole_force(alone.fit, told.fit)) > 0.1 * size
