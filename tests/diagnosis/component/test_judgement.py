"""The common verdict of component tests, from errors and findings that are given."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.component.judgement import JudgedComponent, concluded
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.rules import RULES

SIZE = 100.0  # N
TASK = SimpleNamespace(force=SIZE * np.tile([1.0, -1.0], 100), split=140)


def judged(
    before: float,
    after: float,
    laws: tuple[EffectKind, ...] = (),
    *,
    floor: float = 0.01,
    wrong_sign: bool = False,
    named: bool = True,
) -> JudgedComponent:
    """A test whose model errs by `before` and, with its laws, by `after` of the force."""
    pieces = [SimpleNamespace(effect_kind=kind, effect=kind.name) for kind in laws]
    steps = tuple(SimpleNamespace(delta_bic=-100.0 - number) for number in range(len(laws)))
    base: Any = SimpleNamespace(held_out=(before * SIZE) ** 2)
    final: Any = SimpleNamespace(held_out=(after * SIZE) ** 2, model=SimpleNamespace(pieces=pieces))
    record: Any = SimpleNamespace(task=TASK, given=SimpleNamespace(pieces=()))
    found: Any = SimpleNamespace(steps=steps)
    return JudgedComponent(record, found, base, final, floor * SIZE, wrong_sign, None, named)


def test_errors_are_shares_of_the_held_out_force() -> None:
    errors = judged(0.5, 0.1, floor=0.02).errors
    assert (errors.before[0], errors.after[0], errors.floor[0]) == pytest.approx((0.5, 0.1, 0.02))


@pytest.mark.parametrize(
    ("tests", "verdict"),
    [
        ([judged(0.01, 0.01)], "consistent"),
        ([judged(0.5, 0.01, (EffectKind.LISTED,))], "missing_physics"),
        ([judged(0.5, 0.01, (EffectKind.LISTED,), named=False)], "unknown_physics"),  # the closest, and not named
        ([judged(0.01, 0.01, (EffectKind.NUISANCE,))], "consistent"),  # a preload
        ([judged(0.01, 0.01, wrong_sign=True)], "sensor_fault"),
        ([judged(0.5, 0.01, (EffectKind.LISTED,), wrong_sign=True)], "missing_physics"),
        ([judged(0.5, 0.4)], "unknown_physics"),  # nothing found, most of it left
        ([judged(0.01, 0.01), judged(0.5, 0.01, (EffectKind.LISTED,))], "missing_physics"),  # one of two components
    ],
)
def test_the_verdict_follows_from_all_tests_of_a_recording(tests: list[JudgedComponent], verdict: str) -> None:
    assert concluded(tests, RULES).verdict == verdict


def test_what_is_explained_is_the_fall_of_the_error_beyond_noise_and_of_findings_alone() -> None:
    explained = concluded([judged(0.5, 0.1, (EffectKind.LISTED,))], RULES).explained
    floor = 0.01**2 + RULES.verdict.least**2
    assert explained == pytest.approx(1 - (0.1**2 - floor) / (0.5**2 - floor))
    assert concluded([judged(0.5, 0.1, (EffectKind.NUISANCE,))], RULES).explained is None
