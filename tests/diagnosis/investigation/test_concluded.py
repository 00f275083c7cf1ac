"""A conclusion does not depend on where the search ended: values that were still moving are fitted to their end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation import diagnose
from sprung.model.diagnosis.investigation.diagnose import begun, concluded
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.system import parse_system
from tests.diagnosis_cases import simulate


@pytest.fixture(scope="module")
def state() -> Investigation:
    return begun(parse_system(QUARTER_CAR), simulate(seconds=10.0, seed=46), Options(), lambda share, text: None)


def _interrupted(state: Investigation) -> Investigation:
    """With values that were half off, after one step towards their end."""
    off = replace(state.fit.point, theta=state.fit.point.theta + 0.5)
    fit = optimise(state.problem, off, iterations=1)
    assert not fit.converged
    return replace(state, fit=fit)


def test_a_search_that_ended_early_concludes_with_the_values_of_one_that_did_not(state: Investigation) -> None:
    whole, early = (concluded(one, lambda share, text: None).final for one in (state, _interrupted(state)))
    assert early.converged
    deviation = np.sqrt(np.diag(whole.covariance))[: len(whole.point.theta)]
    assert np.all(np.abs(early.point.theta - whole.point.theta) < 0.1 * deviation)


def test_values_that_still_move_are_less_sure(state: Investigation, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = concluded(state, lambda share, text: None).final

    def still_moving(problem: Any, fit: Any) -> Any:
        return replace(fit, left=8.0 * fit.grain)

    monkeypatch.setattr(diagnose, "settled", still_moving)
    moving = concluded(state, lambda share, text: None).final
    assert not moving.converged
    wider = 1 + moving.left  # whatever the level of the misfit: the covariance is that of noise alone
    assert moving.left == 8.0 * moving.grain
    np.testing.assert_allclose(np.diag(moving.covariance), wider * np.diag(whole.covariance))


def test_what_is_off_by_less_than_what_is_told_of_it_is_judged_by_what_is_told(
    state: Investigation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Masses and instruments are faults beyond their deviations: those that are reported, with what is unexplained."""
    monkeypatch.setattr(diagnose, "exceeds_noise", lambda state: True)
    monkeypatch.setattr(diagnose, "misfit_covariance", lambda problem, fit: 9.0 * np.eye(len(fit.covariance)))
    outcome = concluded(state, lambda share, text: None)
    for told in (outcome.final, outcome.investigation.fit):
        assert np.all(np.diag(told.covariance) >= 9.0)
