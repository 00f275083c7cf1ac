"""The benchmark that varies every deciding number: what it counts as a change, and that work is not done twice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from sprung.benchmarks.sensitivity import Line, Said, Subject, _rig, recordings
from sprung.model.diagnosis.rules import RULES, Rules

HEALTHY = Said("consistent", (), ())
RUBBING = Said("missing_physics", (("k1", "coulomb_friction"),), (1e-9,))


class Obedient:
    """A subject whose verdict follows one number."""

    name = "made"
    said = RUBBING
    state = object()

    def again(self, stage: str, name: str, rules: Rules) -> Said:
        value = getattr(getattr(rules, stage), name)
        return HEALTHY if value > 1.9 else replace(RUBBING, p_values=(1e-9 * value,))


def line(stage: str, name: str) -> Line:
    return Line(stage, next(field for found, field in RULES.constants() if (found, field.name) == (stage, name)))


def test_a_change_is_told_with_the_value_that_made_it() -> None:
    told = line("verdict", "clear")  # 1.25 to 2.0
    told.vary(cast(Subject, Obedient()))
    figure = told.figure()
    (change,) = figure["changed"]
    assert change["at"] == 2.0 and change["recording"] == "made"
    assert change["verdict"] == ["missing_physics", "consistent"]
    assert figure["p_value_decades"] == pytest.approx(0.1, abs=0.01)  # at 1.25, where the findings are the same


def test_a_component_test_is_not_asked_about_vehicles() -> None:
    told = line("component", "close")
    told.vary(cast(Subject, Obedient()))
    assert told.tried == 0 and told.figure()["changed"] == []


def test_quick_recordings_have_a_fault_each_and_the_channels_of_their_system() -> None:
    made = list(recordings("quick", 8, 3.0, 1))
    assert [name.split("-", 1)[1] for name, _, _ in made][:3] == ["friction", "weak friction", "cubic spring"]
    assert all(record.values.shape == (300, len(system.channels)) for _, system, record in made)
    healthy, rubbing = made[5][2].values, made[0][2].values
    assert np.std(healthy[:, 2]) > 0.1 and np.std(rubbing[:, 2]) > 0.1  # m/s^2


def test_made_recordings_of_a_rig_repeat_with_their_seed() -> None:
    first, again = (_rig(2.0, np.random.default_rng(1)) for _ in range(2))
    assert np.array_equal(first.values, again.values) and first.values.shape == (200, 2)


def test_all_numbers_have_a_line() -> None:
    lines: list[dict[str, Any]] = [Line(stage, field).figure() for stage, field in RULES.constants()]
    assert len({(one["stage"], one["number"]) for one in lines}) == len(lines) > 80
