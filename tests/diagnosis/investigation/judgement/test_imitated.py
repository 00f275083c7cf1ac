"""A law that resembles an element's force is not named where what is left is itself a force of the element's motion."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import STOREY, storey
from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, verdict_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.system import parse_system


def test_a_joint_that_a_law_resembles_is_unknown_and_the_closest_law_is_told() -> None:
    report = diagnose(parse_system(STOREY), storey(np.random.default_rng(1)))
    assert report.verdict == "unknown_physics"
    (unknown,) = report.findings
    assert (unknown.location, unknown.effect) == ("storey", "unknown")
    assert "come closest, but what is left then is itself a force of storey's motion" in unknown.sentence
    assert not report.laws
    assert report.explained is not None and report.explained > 0.9


def test_a_law_that_is_the_elements_keeps_its_name() -> None:
    report = diagnose(parse_system(STOREY), storey(np.random.default_rng(2), count=1))
    assert report.verdict == "missing_physics", report.summary
    assert {(f.location, f.family or f.effect) for f in report.findings} == {("storey", report.findings[0].effect)}


@pytest.mark.parametrize(("imitated", "verdict"), [(False, "missing_physics"), (True, "unknown_physics")])
def test_an_imitation_is_unknown_however_much_it_explains(imitated: bool, verdict: str) -> None:
    errors = HeldOutErrors(np.array([0.30]), np.array([0.05]), np.array([0.01]))
    assert verdict_of([EffectKind.LISTED], errors, imitated=imitated) == verdict
