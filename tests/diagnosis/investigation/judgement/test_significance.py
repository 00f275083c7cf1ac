"""What was found is looked at once more: fits that still fall, findings that have come to nothing, a shared gain."""

from __future__ import annotations

from dataclasses import make_dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.fit import baseline
from sprung.model.diagnosis.investigation import diagnose
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.judgement.significance import without_insignificant
from sprung.model.diagnosis.investigation.measurements.calibration import centred, shared_gain, with_free_gains
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES
from sprung.model.diagnosis.selection.compete import compete
from sprung.model.laws import find_law
from sprung.model.system import parse_system
from tests.diagnosis_cases import simulate


def _heavier(ratio: float) -> Investigation:
    """A quarter car whose body is `ratio` times as heavy as its file says, with that as its finding."""
    system = parse_system(QUARTER_CAR.replace("mass: 8000", f"mass: {8000 / ratio:g}"))
    state = begun(system, simulate(seconds=10.0, seed=46), Options(), lambda share, text: None)
    candidate = next(one for one in state.first.candidates if one.term.key[:2] == ("car", "mass_change"))
    (trial,) = compete(state.problem, state.fit, [candidate])
    return replace(state, fit=trial.fit, found=(AcceptedFinding(trial, (), None, 1e-9),))


@pytest.mark.parametrize(("ratio", "kept"), [(1.0, 0), (1.2, 1)])
def test_a_finding_no_further_from_nothing_than_its_deviation_is_taken_out(ratio: float, kept: int) -> None:
    after = without_insignificant(_heavier(ratio))
    assert len(after.found) == len(after.fit.point.terms) == kept


@pytest.mark.parametrize(("left", "kept"), [(0.0, 1), (1e6, 0)])
def test_what_stated_deviations_do_not_distinguish_from_nothing_is_not_named(
    monkeypatch: pytest.MonkeyPatch, left: float, kept: int
) -> None:
    """Deviations contain what a fit to the whole recording, where it has not converged, may yet move."""
    whole = diagnose._on_whole_recording
    monkeypatch.setattr(diagnose, "_on_whole_recording", lambda state: replace(whole(state), left=left))
    outcome = diagnose.concluded(_heavier(1.2), lambda share, text: None)
    assert len(outcome.investigation.found) == kept


def test_a_fit_that_still_falls_is_fitted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law accepted on a fit that is ten steps from its end leaves what passes for another finding."""
    falls = [50.0, 12.0, 10.0, 10.0]
    fits: list[Any] = [SimpleNamespace(deviance=fall, converged=fall == 10.0, point=None) for fall in falls]
    left = iter(fits)
    monkeypatch.setattr(baseline, "try_optimise", lambda problem, point, steps: next(left))
    begin: Any = SimpleNamespace(deviance=90.0, converged=False, point=None)
    problem: Any = SimpleNamespace(rules=RULES)
    assert baseline.settled(problem, begin) is fits[2]
    monkeypatch.setattr(baseline, "try_optimise", lambda problem, point, steps: None)
    assert baseline.settled(problem, begin) is begin


def test_a_gain_that_all_channels_share_is_taken_out_of_them() -> None:
    gain, lag = find_law("sensor_gain"), find_law("sensor_lag")
    shown = [
        Term(gain, name, (1.02 * own,), known=(0.015,)) for name, own in (("a", 1.01), ("b", 1.0), ("c", 1 / 1.01))
    ]
    shown.append(Term(lag, "a", (1e-4,), known=(2e-3,)))
    np.testing.assert_allclose(shared_gain(shown), (1.02, 0.015 / 3**0.5))
    values = [term.parameters[0] for term in centred(shown)]
    assert values == pytest.approx([1.01, 1.0, 1 / 1.01, 1e-4])
    assert shared_gain(shown[3:]) == (1.0, 0.0)


def test_gains_of_sensors_move_beside_a_law_and_those_of_what_drives_everything_do_not() -> None:
    gain = find_law("sensor_gain")
    kept = [Term(gain, name, (1.01,), known=(0.015,), fixed=(True,)) for name in ("car_a", "road.displacement")]
    kept.append(Term(find_law("mass_change"), "car", (1.01,), known=(0.015,), fixed=(True,)))
    law = Term(find_law("coulomb_friction"), "secondary", (300.0, 0.002), fixed=(False, True))
    fit: Any = make_dataclass("_Fit", ["point"])(Point(np.zeros(0), (*kept, law), np.zeros(0)))
    state: Any = SimpleNamespace(signals=SimpleNamespace(sensor_names=("car_a",)), given=3, calibrations=3)
    assert [term.fixed for term in with_free_gains(state, fit).point.terms] == [(), (True,), (), (False, True)]
