"""Many changes of the structure together imitate any other one: then none of them is named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.investigation.configuration.effects import SIGN_REVERSED, WRONG_BODY
from sprung.model.diagnosis.investigation.judgement import judgement
from sprung.model.diagnosis.investigation.judgement.judgement import another_structure
from sprung.model.diagnosis.investigation.verdict import HeldOutErrors
from sprung.model.diagnosis.rules import RULES
from sprung.model.laws import find_law


def investigation(laws: list[str], moved: bool) -> Any:
    found = [SimpleNamespace(trial=SimpleNamespace(term=SimpleNamespace(law=find_law(name)))) for name in laws]
    effects = [SIGN_REVERSED, WRONG_BODY] if moved else [SIGN_REVERSED]
    return SimpleNamespace(
        options=SimpleNamespace(rules=RULES),
        setup_faults=[SimpleNamespace(effect=effect) for effect in effects],
        found=found,
        calibrations=None,
    )


@pytest.mark.parametrize(
    ("laws", "moved", "after", "other"),
    [
        (["missing_connection", "suspended_mass"], True, 0.02, True),  # three, however well they fit
        (["missing_connection", "suspended_mass"], False, 0.02, False),
        (["missing_connection", "suspended_mass"], False, 0.20, True),  # two that leave 6 % of the power
        (["missing_connection", "suspended_mass"], False, 0.06, True),  # two that leave more than noise
        (["flexible_mode", "suspended_mass"], False, 0.06, True),  # what modes damped one by one are imitated by
        (["flexible_mode", "suspended_mass"], False, 0.02, False),
        (["flexible_mode", "coulomb_friction"], False, 0.06, False),
        (["flexible_mode"] * 3, False, 0.02, False),  # of one car body
        (["missing_connection", "coulomb_friction"], False, 0.20, False),
        (["missing_connection", "sensor_gain", "series_stiffness"], False, 0.02, True),  # what bending is imitated by
        (["missing_connection", "sensor_gain"], False, 0.02, False),
        (["power_law_damping", "mass_change", "sensor_lag"], False, 0.20, True),  # what a second damper is imitated by
        (["power_law_damping", "mass_change", "sensor_lag"], False, 0.02, False),
        (["power_law_damping", "coulomb_friction", "bump_stop"], False, 0.20, False),
        (["power_law_damping", "mass_change"], False, 0.20, False),
    ],
)
def test_changes_of_the_structure_are_named_when_they_are_few(
    laws: list[str], moved: bool, after: float, other: bool
) -> None:
    errors = HeldOutErrors(np.array([0.8]), np.array([after]), np.array([0.02]))
    assert another_structure(investigation(laws, moved), errors) is other


@pytest.mark.parametrize(
    ("off", "of_all", "laws", "after", "other"),
    [
        (3, 16, [], 0.20, True),  # three that leave 6 % of the power
        (3, 16, [], 0.02, False),
        (3, 16, [], 0.06, False),  # three that leave 0.5 %
        (2, 16, [], 0.20, False),
        (1, 16, ["missing_connection"], 0.20, False),
        (2, 16, ["missing_connection"], 0.20, True),
        (9, 16, [], 0.02, True),  # most of them, however well they fit
    ],
)
def test_many_masses_and_instruments_that_are_off_at_once_are_another_structure(
    off: int, of_all: int, laws: list[str], after: float, other: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judgement, "faulty", lambda state: list(range(off)))
    state = investigation(laws, False)
    state.calibrations = of_all
    errors = HeldOutErrors(np.array([0.8]), np.array([after]), np.array([0.02]))
    assert another_structure(state, errors) is other
    assert another_structure(state) is False  # while findings are sought
