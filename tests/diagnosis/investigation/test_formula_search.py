"""Formulas of an unnamed force: sums of two are found by their scores, halves of them and rivals are doubted."""

from __future__ import annotations

import numpy as np
import pytest
from diagnosis_cases import quarter_car, simulate

from sprung.model.diagnosis.investigation.course import Options
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.formula import formula_of
from sprung.model.diagnosis.investigation.formula_doubt import doubt_of, missing, own_size, uncertainty, whole_force
from sprung.model.diagnosis.investigation.formula_search import FormulaSearch, taken_out
from sprung.model.diagnosis.screening.families import UNNAMED
from sprung.model.diagnosis.selection.compete import compete
from sprung.model.laws.grammar import Factor, Shape, law_of

RATE, STOP = 3e6, -1.5e6


@pytest.fixture(scope="module")
def unnamed():
    """An investigation that has begun, and its best unnamed force: a spring that stiffens with the rate, and a stop."""
    record = simulate(lambda d, v: RATE * d * abs(v) + STOP * max(-d - 0.002, 0.0), seconds=12.0, seed=3)
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


def test_both_shapes_of_a_sum_have_the_best_score_of_all(searched):
    singles, pairs = searched
    assert not singles or pairs[0].score > singles[0].score
    assert {part.strip() for part in pairs[0].term.variant.split("+")} == {"d * abs(v)", "max(-d - L, 0)"}


def test_a_sum_is_told_with_its_values_and_its_half_is_doubted(unnamed, searched):
    state, trial = unnamed
    told, reason = formula_of(state.problem, state.fit, trial, state.held)
    assert told is not None and reason == ""
    values = dict(zip((spec.name for spec in told.term.law.parameters), told.term.parameters, strict=True))
    amplitudes = [values["a"], values["b"]]
    assert sorted(amplitudes) == pytest.approx([STOP, RATE], rel=0.05)
    assert missing(state.problem, told.fit) == 0.0
    assert uncertainty(state.problem, told.fit) < 0.1 * own_size(told.fit)
    rate = next(hit for hit in searched[1] if "d * abs(v)" in hit.term.variant)
    half = law_of((Shape(Factor("d", 1), Factor("abs(v)", 1, -1)),))
    single = rate.term.__class__(half, "secondary", (RATE,), scales=(RATE,))
    (alone,) = compete(state.problem, state.fit, [rate.__class__(single, 1.0, rate.family)])
    assert "follows the element's motion" in doubt_of(state.problem, alone, [alone])
    apart = np.std(whole_force(told.fit) - whole_force(alone.fit, told.fit))
    assert apart > 0.1 * own_size(told.fit)
