"""The next experiment: menus, inputs of runs, what a run promises, and that the promise is kept."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sprung.benchmarks.experiment import MENU, VEHICLE, with_law
from sprung.model.experiment import evidence
from sprung.model.experiment.choose import rank_runs
from sprung.model.experiment.drives import loaded, run_inputs
from sprung.model.experiment.evidence import fitted, promise, simulated
from sprung.model.experiment.menu import BUNDLED, Menu, MenuError, MenuRun, check_menu, read_menu
from sprung.model.experiment.rivals import NoRival, rival
from sprung.model.system import load_system, parse_system
from sprung.service.cli import main

SWEEP = MenuRun.model_validate(
    {"signal": {"kind": "sweep", "amplitude": 0.002, "frequency": 0.5, "to": 15.0}, "seconds": 4}
)


def test_the_bundled_menu_is_for_the_bundled_vehicle() -> None:
    check_menu(read_menu(BUNDLED), load_system())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("runs: {}", "runs"),
        ("runs: {a: {seconds: 3}}", "track"),
        ("runs: {a: {track: {speed: -3}}}", "speed"),
        ("runs: {a: {signal: {kind: sweep, amplitude: 1, frequency: 2}}}", "higher"),
        ("runs: {a: {track: {speed: 3}, load: {wagon: 3}}}", "wagon"),
        ("runs: {a: {track: {speed: 3}, seconds: 0.5}}", "windows"),
        ("[", "YAML"),
    ],
)
def test_a_wrong_menu_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "menu.yaml"
    path.write_text(text)
    with pytest.raises(MenuError, match=said) as refused:
        check_menu(read_menu(path), load_system())
    assert "\n" not in str(refused.value)


def test_inputs_of_a_bench_are_their_own_derivatives() -> None:
    system = parse_system(VEHICLE)
    values = run_inputs(system, SWEEP)
    steps = np.diff(values[:, 0]) * system.sample_rate
    middle = 0.5 * (values[1:, 1] + values[:-1, 1])
    assert np.abs(steps - middle).max() < 0.02 * np.abs(middle).max()
    assert np.abs(values[:, 0]).max() == pytest.approx(0.002, rel=0.02)


def test_a_load_changes_mass_and_inertia_alike() -> None:
    system = load_system()
    run = MenuRun.model_validate({"track": {"speed": 30.0}, "load": {"car": 3200.0}})
    before, after = system.file.bodies["car"], loaded(system, run).file.bodies["car"]
    factor = after.mass.value / before.mass.value
    assert after.mass.value == before.mass.value + 3200
    assert before.roll_inertia and after.roll_inertia == pytest.approx(factor * before.roll_inertia)


def test_the_evidence_that_is_promised_comes_with_the_noise() -> None:
    """Mean D and variance 2 D, over noises drawn anew."""
    friction = with_law("coulomb_friction", 0.3)
    bare = parse_system(VEHICLE)
    foreseen = promise(friction, bare, SWEEP).evidence
    came = []
    for seed in range(6):
        values = simulated(friction, SWEEP, 0, np.random.default_rng(seed))
        came.append(fitted(bare, values).misfit - fitted(friction, values).misfit)
    assert foreseen > 10
    assert abs(np.mean(came) - foreseen) < 4 * np.sqrt(2 * foreseen / len(came)) + 0.1 * foreseen


def test_what_even_the_truth_leaves_unexplained_promises_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows too violent for their sampling: their misfit is no evidence."""
    bare, cubic = parse_system(VEHICLE), with_law("cubic_stiffness", 1.0)
    whole = promise(cubic, bare, SWEEP).evidence
    values = simulated(cubic, SWEEP)
    values[-200:, 2:] += np.random.default_rng(0).normal(0, 30 * np.std(values[:, 2:]), values[-200:, 2:].shape)
    monkeypatch.setattr(evidence, "simulated", lambda *_: values)
    assert 0 < promise(cubic, bare, SWEEP).evidence < whole
    monkeypatch.setattr(evidence, "simulated", lambda *_: np.where(values > np.median(values), np.nan, values))
    assert promise(cubic, bare, SWEEP).evidence == 0  # a motion that the simulation has lost


def test_a_model_promises_nothing_against_itself_and_more_on_a_rougher_run() -> None:
    bare, cubic = parse_system(VEHICLE), with_law("cubic_stiffness", 1.0)
    assert promise(cubic, cubic, SWEEP).evidence < 0.5
    runs = {name: MENU.runs[name].model_copy(update={"seconds": 4}) for name in ("slow", "fast, bad track")}
    ranked = rank_runs({"bare": bare, "cubic": cubic}, Menu(runs=runs))
    assert [one.run for one in ranked] == ["fast, bad track", "slow"] and ranked[0].evidence > 3 * ranked[1].evidence


def test_a_rival_takes_the_place_of_a_law_with_values_that_come_near() -> None:
    friction = with_law("coulomb_friction", 1.0)
    inputs = run_inputs(friction, MENU.runs["slow"])
    other = rival(friction, "strut", "coulomb_friction", "damper_blowoff", inputs)
    (law,) = other.laws
    assert law.law.name == "damper_blowoff" and law.values[0] > 0
    with pytest.raises(NoRival, match="bending"):
        rival(friction, "strut", "coulomb_friction", "bending_mode", inputs)
    with pytest.raises(NoRival, match="body_a"):
        rival(friction, "body_a", "sensor_lag", "series_stiffness", inputs)  # what a sensor shows is no element's force


def test_the_command_ranks_the_runs_of_a_menu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.yaml").write_text(VEHICLE)
    law = "1500, laws: [{cubic_stiffness: {k3: 4.0e6}}]"
    (tmp_path / "b.yaml").write_text(VEHICLE.replace("1500", law))
    (tmp_path / "menu.yaml").write_text(
        "runs: {small: {signal: {kind: sine, amplitude: 0.0005, frequency: 1}, seconds: 3},"
        " large: {signal: {kind: sine, amplitude: 0.02, frequency: 1}, seconds: 3, cost: 2}}"
    )
    files = [str(tmp_path / name) for name in ("a.yaml", "b.yaml")]
    assert main(["experiment", *files, "--menu", str(tmp_path / "menu.yaml"), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert runs[0]["run"] == "large" and runs[0]["evidence_per_cost"] == pytest.approx(
        runs[0]["evidence"] / 2, rel=0.01
    )
    report = {"findings": [{"location": "strut", "effect": "cubic_stiffness", "look_alikes": {"bump_stop": 3.0}}]}
    (tmp_path / "report.json").write_text(json.dumps(report))
    (tmp_path / "system.yaml").write_text((tmp_path / "b.yaml").read_text())
    assert main(["experiment", str(tmp_path / "report.json"), "--menu", str(tmp_path / "menu.yaml")]) == 0
    assert "strut: bump_stop" in capsys.readouterr().out
    assert main(["experiment", files[0]]) == 2
    assert "a single model" in capsys.readouterr().err
