"""The verdict as a function of errors, bounded noise and findings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.investigation.verdict import HeldOutErrors, bounded_noise, kind_of, verdict_of
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.laws import CATALOGUE
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.hysteresis import BOUC_WEN
from sprung.model.laws.sensor_faults import SENSOR_GAIN


def errors(before: float, after: float, floor: float) -> HeldOutErrors:
    return HeldOutErrors(np.array([before]), np.array([after]), np.array([floor]))


EFFECTS = {law.name: kind_of(law) for law in CATALOGUE} | {UNKNOWN: EffectKind.UNLISTED}


@pytest.mark.parametrize(
    ("effects", "before", "after", "floor", "verdict"),
    [
        ([], 0.03, 0.03, 0.03, "consistent"),
        (["preload"], 0.03, 0.03, 0.03, "consistent"),
        ([], 0.33, 0.33, 0.13, "unknown_physics"),
        ([], 0.587, 0.587, 0.018, "unknown_physics"),
        (["bouc_wen"], 0.33, 0.08, 0.03, "missing_physics"),
        (["bouc_wen"], 0.339, 0.301, 0.055, "unknown_physics"),
        (["time_varying_stiffness"], 1.4, 0.51, 0.03, "unknown_physics"),  # most of what was there, and half is left
        (["unknown"], 0.6, 0.1, 0.05, "unknown_physics"),
        (["sensor_gain"], 0.3, 0.03, 0.03, "sensor_fault"),
        (["sensor_bias"], 1.45, 1.01, 0.1, "unknown_physics"),
        (["sensor_gain", "bump_stop"], 0.3, 0.03, 0.03, "missing_physics"),
    ],
)
def test_verdicts(effects: list[str], before: float, after: float, floor: float, verdict: str) -> None:
    assert verdict_of([EFFECTS[effect] for effect in effects], errors(before, after, floor)) == verdict


def test_nothing_is_cleared_by_another_structure_or_while_candidates_were_left_out() -> None:
    floor = errors(0.03, 0.03, 0.03)
    assert verdict_of([], floor, ended=True) == "unknown_physics"
    found = [kind_of(BOUC_WEN)]
    assert verdict_of(found, errors(0.3, 0.03, 0.03), ended=True) == "missing_physics"
    assert verdict_of(found, errors(0.3, 0.03, 0.03), other_structure=True) == "unknown_physics"


def test_no_all_clear_above_twice_the_floor() -> None:
    cleared = 0
    for floor in np.geomspace(1e-3, 0.3, 20):
        for after in np.geomspace(1e-3, 1.0, 40):
            e = errors(after, after, floor)
            if verdict_of([], e) == "consistent":
                assert after <= 2 * e.bounded()[0]
                cleared += 1
    assert 100 < cleared < 700


def test_one_sensor_far_above_its_floor_is_enough() -> None:
    many = HeldOutErrors(np.array([0.02, 0.02, 0.02, 0.1]), np.array([0.02, 0.02, 0.02, 0.1]), np.full(4, 0.02))
    assert verdict_of([], many) == "unknown_physics"
    assert np.count_nonzero(many.unexplained()) >= 1


def test_everything_explained_is_said_only_when_nothing_is_left() -> None:
    assert errors(0.3, 0.03, 0.03).explained() == 1.0
    left = errors(0.3, 0.1, 0.03)
    part = left.explained()
    assert part is not None and part < 1.0
    assert left.unexplained()[0] == pytest.approx(0.1**2 - left.bounded()[0] ** 2)


def test_a_floor_learnt_from_the_misfit_is_bounded_by_what_was_declared_or_measured() -> None:
    np.testing.assert_allclose(
        bounded_noise(np.array([300.0, 1.0]), np.array([5.0, 1.2]), np.array([4.0, 1.0])), [7.5, 1.0]
    )


def test_a_fault_among_the_laws_of_a_user_is_a_fault() -> None:
    own = replace(SENSOR_GAIN, name="icing")
    assert kind_of(own) is EffectKind.FAULT
    assert verdict_of([kind_of(own)], errors(0.3, 0.03, 0.03)) == "sensor_fault"
