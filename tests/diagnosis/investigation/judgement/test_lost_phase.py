"""Where the free run loses its phase, what is said to be explained and left is what the verdict is based on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.diagnose import begun, concluded
from sprung.model.diagnosis.investigation.judgement.judgement import held_out_runs, judged
from sprung.model.diagnosis.investigation.state import Outcome
from sprung.model.diagnosis.report.compose import compose
from sprung.model.system import parse_system
from tests.diagnosis.test_oscillator import SYSTEM, simulate
from tests.diagnosis_cases import MadeRecord


@pytest.fixture(scope="module")
def case() -> tuple[Outcome, MadeRecord]:
    """A linear oscillator as concluded, and its record."""
    record = simulate(lambda d, v, z: 0.0, seconds=8.0)
    state = begun(parse_system(SYSTEM), record, Options(), lambda share, text: None)
    assert state.problem.process_noise
    return concluded(state, lambda share, text: None), record


def out_of_phase(outcome: Outcome, left: float) -> Outcome:
    """The same with a free run that errs by more than the signal, and this share of unmeasured forces."""
    state, after = outcome.investigation, replace(outcome.runs.after, per_sensor=np.array([1.3]))
    runs = held_out_runs(state, outcome.runs.before, after, outcome.runs.noisy)
    runs = replace(runs, errors=replace(runs.errors, after=after.per_sensor))
    structure = state.fit.forward.plant.structure
    inertia = structure.mass * state.fit.forward.part.grid.inverse(state.fit.motions.acceleration)
    force = np.full(len(state.fit.noise.force), left * float(np.sqrt(np.mean(inertia**2))))
    fit = replace(state.fit, noise=replace(state.fit.noise, force=force))
    state = replace(state, fit=fit)
    return replace(outcome, investigation=state, runs=runs, judgement=judged(state, runs))


def test_what_is_left_is_said_of_the_unmeasured_forces_and_not_of_the_free_run(
    case: tuple[Outcome, MadeRecord],
) -> None:
    outcome, record = case
    report = compose(out_of_phase(outcome, 0.2), record)
    assert report.verdict == "unknown_physics"
    assert "unmeasured forces of 20 % of the inertia forces" in report.summary
    assert "% of position" not in report.summary
    assert report.unexplained.share == pytest.approx(0.04, rel=0.1) and not report.unexplained.per_sensor


def test_a_lost_phase_leaves_nothing_where_the_forces_are_known(case: tuple[Outcome, MadeRecord]) -> None:
    outcome, record = case
    told = out_of_phase(outcome, 1e-4)
    assert told.judgement.lost_phase and not outcome.judgement.lost_phase
    report = compose(told, record)
    assert report.verdict == "consistent"
    assert report.unexplained.share == 0.0 and not report.unexplained.where
