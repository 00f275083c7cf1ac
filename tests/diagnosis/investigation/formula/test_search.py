"""Formulas of an unnamed force: sums of two are found by their scores, halves of them and rivals are doubted."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.fit.optimise import try_optimise
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.formula.rejection import (
    doubt_of,
    missing,
    nonlinear_rms,
    uncertainty,
    whole_force,
)
from sprung.model.diagnosis.investigation.formula.search import formula_of
from sprung.model.diagnosis.investigation.formula.shapes import FormulaSearch, without_last_term
from sprung.model.diagnosis.investigation.state import Investigation, Options
from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.families import ELEMENT, UNNAMED
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial, compete
from sprung.model.diagnosis.selection.starts import start_of
from sprung.model.laws.grammar import Factor, Shape, law_of
from tests.diagnosis_cases import DAMPING, STIFFNESS, quarter_car, simulate

RATE, STOP, GAP = 2e6, -4e5, 0.002


@pytest.fixture(scope="module")
def unnamed() -> tuple[Investigation, Trial]:
    """An investigation that has begun, and its best unnamed force: a spring that stiffens with the rate, and a stop."""
    record = simulate(lambda d, v: RATE * d * abs(v) + STOP * max(-d - GAP, 0.0), seconds=12.0, seed=3)
    state = begun(quarter_car(), record, Options(), lambda share, text: None)
    candidates = [
        candidate
        for candidate in state.last.candidates
        if candidate.family is UNNAMED and candidate.location == "secondary"
    ]
    return state, compete(state.problem, state.fit, candidates)[0]


def test_the_residual_without_a_force_is_that_force_and_noise(unnamed: tuple[Investigation, Trial]) -> None:
    state, trial = unnamed
    bare = without_last_term(state.problem, trial.fit)
    assert bare.chi_square > 5 * trial.fit.chi_square
    assert bare.jacobian.shape[1] == trial.fit.jacobian.shape[1] - len(trial.term.parameters)
    assert len(bare.point.terms) == len(trial.fit.point.terms) - 1


def test_no_pair_at_random_scores_more_than_the_pairs_that_are_found(unnamed: tuple[Investigation, Trial]) -> None:
    state, trial = unnamed
    search = FormulaSearch.along(state.problem, trial.fit)
    singles, pairs = search.best()
    best, rng, known = max(pair.score for pair in pairs), np.random.default_rng(1), list(search.known)
    assert all(single.score < best for single in singles)
    for _ in range(200):
        one, other = (known[i] for i in rng.choice(len(known), 2, replace=False))
        score, _ = search.motion.channel.joint(np.stack([search.spectrum(*one), search.spectrum(*other)]))
        assert score < 1.001 * best or one[0].memory or other[0].memory


def test_a_fit_of_a_formula_begins_where_everything_has_moved_along(unnamed: tuple[Investigation, Trial]) -> None:
    state, trial = unnamed
    candidate = FormulaSearch.along(state.problem, trial.fit).best()[1][0]
    assert candidate.start is not None and candidate.start.terms[-1].parameters == pytest.approx(
        candidate.term.parameters
    )
    moved = try_optimise(state.problem, candidate.start, 1, trial.fit.whitener)
    plain = try_optimise(state.problem, start_of(state.fit, candidate), 1, trial.fit.whitener)
    assert moved is not None and (plain is None or moved.chi_square < plain.chi_square)


@pytest.mark.slow
def test_a_sum_is_reported_with_its_force_and_its_half_is_doubted(unnamed: tuple[Investigation, Trial]) -> None:
    state, trial = unnamed
    told, reason = formula_of(state.problem, state.fit, trial, state.held)
    assert told is not None and reason == ""
    d, v = ((part @ told.term.port(state.system))[::OVERSAMPLING] for part in told.fit.element_motion)
    truth = (
        STIFFNESS["secondary"] * d + DAMPING["secondary"] * v + RATE * d * np.abs(v) + STOP * np.maximum(-d - GAP, 0)
    )
    size = nonlinear_rms(told.fit)
    assert np.std(whole_force(told.fit) - truth) < 0.07 * size
    assert missing(state.problem, told.fit) < 0.05 and uncertainty(state.problem, told.fit) < 0.1 * size
    half = law_of((Shape(Factor("d", 1), Factor("abs(v)", 1, -1)),))
    (alone,) = compete(
        state.problem, state.fit, [Candidate(Term(half, "secondary", (RATE,), scales=(RATE,)), 1.0, ELEMENT)]
    )
    assert "depends on the element's motion" in doubt_of(state.problem, alone, [alone])
    assert np.std(whole_force(told.fit) - whole_force(alone.fit, told.fit)) > 0.1 * size
