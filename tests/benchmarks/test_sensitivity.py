"""The benchmark that varies every deciding number: what it counts as a change, and that work is not done twice."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from sprung.benchmarks.sensitivity import ReportedResult, Subject, figure, quoted, run, vary
from sprung.benchmarks.sensitivity_cases import recordings, rig
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.rule import reason_of

HEALTHY = ReportedResult("consistent", (), ())
RUBBING = ReportedResult("missing_physics", (("k1", "coulomb_friction"),), (1e-9,))


class Obedient:
    """A subject whose verdict follows one number."""

    name = "made"
    reads = ()
    said = RUBBING
    state = object()

    def again(self, stage: str, name: str, rules: Rules) -> ReportedResult:
        value = getattr(getattr(rules, stage), name)
        return HEALTHY if value > 1.9 else replace(RUBBING, p_values=(1e-9 * value,))


def varied(stage: str, name: str) -> dict[str, Any] | None:
    number = next(field for found, field in RULES.constants() if (found, field.name) == (stage, name))
    return vary(cast(Subject, Obedient()), stage, number)


def test_a_change_is_reported_with_the_value_that_made_it() -> None:
    told = varied("verdict", "clear")  # 1.25 to 2.0
    assert told is not None
    (change,) = told["changed"]
    assert change["at"] == 2.0 and change["recording"] == "made"
    assert change["verdict"] == ["missing_physics", "consistent"]
    assert told["decades"] == pytest.approx(0.1, abs=0.01)  # at 1.25, where the findings are the same


def test_a_component_test_is_not_asked_about_vehicles() -> None:
    assert varied("component", "close") is None


def test_quick_recordings_have_a_fault_each_and_the_channels_of_their_system() -> None:
    made = [(name, *make()) for name, make in recordings("quick", 8, 3.0, 1) if name != "fast"]
    assert [name.split("-", 1)[1] for name, _, _ in made[:3]] == ["friction", "weak friction", "cubic spring"]
    assert all(record.values.shape == (300, len(system.channels)) for _, system, record in made[:8])
    assert made[8][0] == "tower" and made[8][2].values.shape == (18000, 2)
    assert all(record.values.shape[1] == len(system.channels) for _, system, record in made)
    assert len({name for name, _, _ in made}) == len(made)
    healthy, rubbing = made[5][2].values, made[0][2].values
    assert np.std(healthy[:, 2]) > 0.1 and np.std(rubbing[:, 2]) > 0.1  # m/s^2


def test_numbers_and_recordings_can_be_asked_for_alone_and_others_keep_what_was_known(tmp_path: Path) -> None:
    file, before = tmp_path / "varied.json", {"varied": [1, 0, 2], "recordings": 3, "changes": []}
    file.write_text(json.dumps({"set": "", "recordings": [], "numbers": {"component.most": before}}))
    lines = list(run(stage="report.sure,verdict.parts", cases="5-healthy", seconds=3.0, write=file))
    assert [line["recording"] for line in lines[:1]] == ["5-healthy"]
    assert [(line["stage"], line["number"]) for line in lines[1:-1]] == [("verdict", "parts"), ("report", "sure")]
    known = json.loads(file.read_text())["numbers"]
    assert known["component.most"] == before and known["report.sure"]["recordings"] == 1


def test_a_number_that_was_varied_on_an_earlier_set_names_that_one() -> None:
    done = [{"recording": name, "varied": {"verdict.clear": varied("verdict", "clear")}} for name in ("made", "other")]
    lines = [figure(stage, field, done) for stage, field in RULES.constants() if stage == "verdict"]
    known = {"varied": [RULES.fit.prior, 1.0, 100.0], "recordings": 1, "changes": []}
    before = {"set": "1 recordings (quick)", "recordings": ["made"], "numbers": {"fit.prior": known}}
    found = json.loads(quoted(lines, done, "recordings (quick)", before))
    assert found["set"] == "2 recordings (quick)" and found["numbers"]["fit.prior"]["of"] == "1 recordings (quick)"
    number = next(one for stage, one in RULES.constants() if (stage, one.name) == ("fit", "prior"))
    ends = {"varied": [number.default, *number.metadata["range"]]}
    found["numbers"]["fit.prior"] |= ends
    assert "on 1 of 1 recordings (quick) insensitive" in reason_of("fit", number, found)


def test_made_recordings_of_a_rig_repeat_with_their_seed() -> None:
    first, again = (rig(np.random.default_rng(1), 2.0) for _ in range(2))
    assert np.array_equal(first.values, again.values) and first.values.shape == (200, 2)


def test_all_numbers_have_a_line() -> None:
    lines = [figure(stage, field, []) for stage, field in RULES.constants()]
    assert len({(one["stage"], one["number"]) for one in lines}) == len(lines) > 80


def test_a_recording_that_is_done_is_not_done_again(tmp_path: Path) -> None:
    first = list(run(stage="report", count=2, seconds=3.0, part="2/2", cases="rig-0", folder=tmp_path))
    (kept,) = tmp_path.glob("*.json")
    kept.write_text(kept.read_text().replace('"verdict": "missing_physics"', '"verdict": "as kept"'))
    again = list(run(stage="report", count=2, seconds=3.0, part="2/2", cases="rig-0", folder=tmp_path))
    assert first[0]["verdict"] == "missing_physics" and again[0]["verdict"] == "as kept"
    assert again[1:-1] == first[1:-1]
    other = list(run(stage="report", count=2, seconds=3.0, part="2/2", cases="rig-0", seed=1, folder=tmp_path))
    assert other[0]["verdict"] != "as kept"  # another recording


def test_only_numbers_that_are_not_known_are_varied(tmp_path: Path) -> None:
    list(run(stage="report", count=2, seconds=3.0, part="2/2", cases="rig-0", folder=tmp_path))
    (kept,) = tmp_path.glob("*.json")
    known = json.loads(kept.read_text())
    known["told"]["varied"]["report.far"]["varied"] = [0, 0, 0]  # it had another value then
    known["told"]["varied"]["report.loose"]["found"] = {"changed": [], "decades": 7.0}
    kept.write_text(json.dumps(known))
    list(run(stage="report", count=2, seconds=3.0, part="2/2", cases="rig-0", folder=tmp_path))
    now = json.loads(kept.read_text())["told"]["varied"]
    assert now["report.far"]["varied"] == [1.6, 1.1, 2.3] and now["report.loose"]["found"]["decades"] == 7.0


def test_what_is_quoted_of_a_run_is_json_of_every_number_that_was_varied() -> None:
    told = varied("verdict", "clear")
    done = [{"recording": "made", "varied": {"verdict.clear": told}}]
    lines = [figure(stage, field, done) for stage, field in RULES.constants()]
    found = json.loads(quoted(lines, done, "recordings (quick)", code="0123abcd"))
    assert list(found["numbers"]) == ["verdict.clear"] and found["numbers"]["verdict.clear"]["code"] == "0123abcd"
    (change,) = found["numbers"]["verdict.clear"]["changes"]
    assert change == "at 2 the verdict in made: missing_physics -> consistent"


def test_what_is_known_of_more_recordings_stays_while_the_number_is_what_it_was() -> None:
    done = [{"recording": "made", "varied": {"verdict.clear": varied("verdict", "clear")}}]
    lines = [figure(stage, field, done) for stage, field in RULES.constants()]
    known = {"varied": [1.5, 1.25, 2.0], "recordings": 8, "changes": []}
    other = known | {"varied": [1.4, 1.25, 2.0]}
    for before, kept in (({"verdict.clear": known}, 8), ({"verdict.clear": other}, 1), ({}, 1)):
        found = json.loads(quoted(lines, done, "recordings (quick)", {"recordings": [], "numbers": before}))
        assert found["numbers"]["verdict.clear"]["recordings"] == kept


def test_what_is_known_of_stages_that_were_not_varied_stays() -> None:
    done = [{"recording": "made", "varied": {"verdict.clear": varied("verdict", "clear")}}]
    lines = [figure(stage, field, done) for stage, field in RULES.constants() if stage == "verdict"]
    known = {"varied": [1.0, 0.5, 2.0], "recordings": 8, "changes": []}
    numbers = {"fit.prior": known, "verdict.gone": known}
    before = {"set": "8 recordings (quick)", "recordings": [str(number) for number in range(8)], "numbers": numbers}
    found = json.loads(quoted(lines, done, "recordings (quick)", before))
    assert list(found["numbers"]) == ["fit.prior", "verdict.clear"]
    assert found["set"] == before["set"] and found["recordings"] == before["recordings"]
    assert found["numbers"]["verdict.clear"]["on"] == ["made"]  # which is none of that set
