"""Likely reasons why nothing fits, from what sensors and a free run show; calibration errors in words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.report import advice
from sprung.model.diagnosis.report.advice import likely_reasons, nothing_fits, undecided
from sprung.model.diagnosis.report.calibration import in_words
from sprung.model.diagnosis.report.report import IdentifiedLaw, LawParameter
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import CATALOGUE
from tests.diagnosis_cases import quarter_car

SHOWN = np.random.default_rng(3).standard_normal((500, 4))


def outcome(
    factors: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
    theta: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    *,
    rejected: bool = True,
    parts: int = 0,
) -> Any:
    """A free run of which each sensor measured so many times what is simulated."""
    system = quarter_car()
    base = SimpleNamespace(covariance=1e-6 * np.eye(4), point=SimpleNamespace(theta=np.array(theta)))
    investigation = SimpleNamespace(
        system=system,
        signals=SimpleNamespace(sensor_names=system.sensors),
        options=SimpleNamespace(rules=RULES),
        setup_faults=(),
        base=base,
    )
    judgement = SimpleNamespace(rejected=rejected, parts=parts, error=0.83)
    before = SimpleNamespace(measured=SHOWN * np.array(factors), simulated=SHOWN)
    return SimpleNamespace(investigation=investigation, judgement=judgement, runs=SimpleNamespace(before=before))


def test_a_sensor_that_shows_the_opposite_has_the_wrong_sign() -> None:
    assert likely_reasons(outcome((1.0, -1.0, 1.0, 1.0)))[0] == "the sign of car_b"


def test_a_sensor_that_shows_a_multiple_has_another_unit() -> None:
    (first, *others) = likely_reasons(outcome((1.0, 1.0, 9.81, 1.0)))
    assert first == "bogie_a is 9.81 times what it should show (a unit or a scale?)"
    assert len(others) == 2 and others[0] == "an unmeasured excitation"


def test_a_value_far_from_nominal_is_told_and_one_within_the_rules_is_not() -> None:
    far = np.log(2) + 1.1 * RULES.report.far
    system = quarter_car()
    reasons = likely_reasons(outcome(theta=(0.0, far, 0.0, 0.0)))
    assert reasons[0].startswith(f"{system.parameters[1].name} came out {np.exp(far):.2g} times nominal")
    assert likely_reasons(outcome(theta=(0.0, 0.5 * RULES.report.far, 0.0, 0.0)))[0] == "an unmeasured excitation"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"parts": 3}, "the structure is another one than the file's: 3 changes of it"),
        ({"rejected": True}, "nothing fits: the best model still errs by 83 % of the signal"),
        ({"rejected": False}, "nothing fits: the free run loses its phase"),
    ],
)
def test_what_is_said_follows_from_the_judgement(settings: dict[str, Any], words: str) -> None:
    assert nothing_fits(outcome(**settings)).startswith(words)


def test_parameters_that_the_recording_does_not_determine_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    state = outcome().investigation
    names = [p.name for p in state.system.parameters]
    loose = RULES.report.loose
    monkeypatch.setattr(advice, "deviations", lambda system, fit: np.array([0.1, 2.0, 0.1, 0.1]) * loose)
    (line,) = undecided(state)
    assert line.startswith(f"undecided: {names[1]}: ") and not any(name in line for name in (names[0], *names[2:]))
    monkeypatch.setattr(advice, "deviations", lambda system, fit: np.full(4, 0.5 * loose))
    assert undecided(state) == []


def test_calibration_errors_are_said_with_what_they_scale_and_no_more_than_four() -> None:
    gain = IdentifiedLaw("car_a", "sensor_gain", (LawParameter("gain", 1.02, 0.001, "1"),))
    mass = IdentifiedLaw("car", "mass_change", (LawParameter("ratio", 1.1, 0.01, "1"),))
    assert in_words((), CATALOGUE) == ""
    assert in_words((mass, gain), CATALOGUE).startswith("within calibration: car mass ratio 1.1")
    assert in_words((gain,) * 6, CATALOGUE).endswith(" and 2 more")
    doubted = in_words((mass, gain), CATALOGUE, {("car", "mass_change")})
    assert doubted.startswith("within calibration: ")
    assert "; too uncertain to be called a fault: car mass ratio 1.1" in doubted
