"""A system file nobody has trained for, its road measured by an accelerometer: every command works at once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.model.identification.excitation import simulate_runs
from sprung.model.system import System, load_system
from sprung.model.tracking.tracker import Tracker
from sprung.service.app import create_app
from sprung.service.cli import main
from sprung.service.core import build_core
from sprung.service.monitoring.engine import load_engine
from sprung.service.settings import Settings
from tests.strut import TEXT
from tests.test_system import QUARTER_CAR

TRUTH = {"tyre.stiffness": 0.9, "strut.stiffness": 1.15, "tyre.damping": 1.0, "strut.damping": 0.8}
MEASURED = "displacement: {csv: z, noise: 1e-5}, velocity: {csv: vz, noise: 1e-3}"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "car.yaml"
    file.write_text(QUARTER_CAR.replace(MEASURED, "acceleration: {csv: az, noise: 0.1}"))
    return file


def ride(system: System, seconds: int) -> np.ndarray:
    log_ratio = np.log([[TRUTH[p.name] for p in system.parameters]])
    samples = round(seconds * system.sample_rate)
    values = simulate_runs(system, log_ratio, samples, np.random.default_rng(5), roughness=(5e-6, 5e-6)).values[0]
    values[:, 0] += 0.4  # the accelerometer's offset
    return values


def test_identify_takes_accelerations_of_supports(path: Path, data_dir: Path) -> None:
    system = load_system(path)
    values = ride(system, 1)
    core = build_core(Settings(data_dir=data_dir), load_engine(Settings(system=path, data_dir=data_dir)))
    channels = {c.name: values[:, i].tolist() for i, c in enumerate(system.channels)}
    assert "road.acceleration" in channels
    with TestClient(create_app(core)) as client:
        body = {"vehicle": "car", "sample_rate": system.sample_rate, "channels": channels}
        answer = client.post("/identify?states=true", json=body)
        assert answer.status_code == 200, answer.text
        for parameter in answer.json()["parameters"]:
            if parameter["identifiable"]:
                assert abs(parameter["ratio"] - TRUTH[parameter["name"]]) < 4 * parameter["std"] / parameter["nominal"]
        del channels["road.acceleration"]
        assert "road.acceleration" in client.post("/identify", json=body).text


def test_replay_and_simulate_take_accelerations_of_supports(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    system = load_system(path)
    values = ride(system, 12)
    table = tmp_path / "ride.csv"
    time = 1.79e9 + np.arange(len(values)) / system.sample_rate
    header = ",".join(["time", *(channel.table or "" for channel in system.channels)])
    np.savetxt(
        table,
        np.column_stack([time, values]),
        delimiter=",",
        header=header,
        comments="",
        fmt=["%.3f"] + ["%.9g"] * len(system.channels),
    )
    assert main(["replay", str(table), "--system", str(path), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])["summary"]
    assert summary["windows"]["used"] >= 22 and summary["health"] == "ok"
    for parameter in summary["parameters"]:
        if parameter["identifiable"]:
            assert abs(parameter["ratio"] - TRUTH[parameter["name"]]) < 4 * parameter["std"] / parameter["nominal"]
    assert main(["simulate", str(path), "--inputs", str(table), "--out", str(tmp_path / "shown.csv")]) == 0
    assert len((tmp_path / "shown.csv").read_text().splitlines()) == len(values) + 1


def test_weights_that_are_not_used_are_said_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "strut.yaml"
    file.write_text(TEXT.format(law="{coulomb_friction: {force: 80, smoothing: 0.01}}", sensor=""))
    load_engine(Settings(system=file, weights=tmp_path, data_dir=tmp_path))
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"{tmp_path}: these weights are not used: quarter-car has laws")


def test_states_of_versions_that_knew_less_or_more_stop_nothing(path: Path, tmp_path: Path) -> None:
    engine = load_engine(Settings(system=path, data_dir=tmp_path))
    now = engine.tracker
    older = Tracker(now.parameters, now.settings, now.deviations[:-2])
    state = engine.load_state(older.initial_state().to_dict())
    assert len(state.calibration.reference) == now.model.size > older.model.size
    assert [one.name for one in now.report(state)] == [p.name for p in engine.system.tracked]
    downgraded = replace(engine, tracker=older).load_state(now.initial_state().to_dict())
    assert len(older.report(downgraded)) == len(engine.system.tracked)
