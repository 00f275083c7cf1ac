"""The main job as its user does it: recordings in, drift out, with the trained model and nothing faked."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.system import load_system
from sprung.service.cli import main

DRIFT = Path(__file__).parent / "data" / "drift-600s.blf"
SHARED = Path(__file__).parents[1].parent / "shared" / "recordings"
# What drifts in the bundled recording: parameter, share lost in the end, time constant (from 5 s before its start).
DRIFTING = (("secondary_2l.damping", 0.45, 250.0), ("primary_12r.stiffness", 0.2, 300.0))


def replay(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[dict[str, Any]], str]:
    status = main(["replay", *map(str, arguments), "--json"])
    captured = capsys.readouterr()
    return status, [json.loads(line) for line in captured.out.splitlines()], captured.err


def shared(name: str) -> Path:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{name} is not at hand")
    return path


def labels(name: str) -> dict[str, float]:
    truth = json.loads(shared("labels.json").read_text())[name]
    return {f"{e}.{q}": v for q in ("stiffness", "damping") for e, v in truth[q].items()}


def test_the_bundled_recording_shows_two_parameters_drift_and_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    status, lines, _ = replay(capsys, DRIFT)
    summary = lines[-1]["summary"]
    assert status == 1  # the vehicle has alarms
    assert {a["parameter"] for a in summary["alarms"]} == {name for name, *_ in DRIFTING}
    assert summary["frames"] == {"used": 420000, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 0}
    assert summary["windows"] == {"used": 1199, "repaired": 0, "dropped": 0}
    assert all(p["identifiable"] for p in summary["parameters"])
    assert len(summary["parameters"]) == 24
    # Followed within 3 % from 60 s on: the truth is known relative to the values before the record.
    for name, late, tau in DRIFTING:
        posterior = np.array([line["posterior"][name][0] for line in lines[:-1] if line["outcome"] != "dropped"])
        seconds = 1 + 0.5 * np.arange(len(posterior))
        truth = 1 - late * (1 - np.exp(-(seconds + 5) / tau))
        ratio = posterior / truth
        assert np.abs(ratio / np.median(ratio[seconds > 300]) - 1)[seconds > 60].max() < 0.03


def test_a_healthy_vehicle_is_measured_within_its_intervals_and_raises_no_alarm(
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, lines, _ = replay(capsys, shared("healthy-120s.mcap"))
    summary = lines[-1]["summary"]
    truth = labels("healthy-120s.mcap")
    z = [abs(p["value"] - truth[p["name"]]) / p["std"] for p in summary["parameters"]]
    assert status == 0
    assert summary["alarms"] == []
    assert np.sum(np.array(z) < 3) >= 23


@pytest.mark.parametrize(("name", "foreign"), [("lossy-30s.mcap", False), ("lossy-30s.blf", True)])
def test_losses_are_counted_and_told_in_one_line(capsys: pytest.CaptureFixture[str], name: str, foreign: bool) -> None:
    status, lines, errors = replay(capsys, shared(name))
    summary = lines[-1]["summary"]
    truth = labels(name)
    assert status == 1
    assert len(errors.strip().splitlines()) == 1
    assert "lost" in errors or "missing" in errors
    assert (summary["frames"]["foreign"] > 0) == foreign
    assert sum(summary["windows"].values()) >= 58
    assert all(line["reason"] for line in lines[:-1] if line["outcome"] != "used")
    z = [abs(p["value"] - truth[p["name"]]) / p["std"] for p in summary["parameters"]]
    assert np.sum(np.array(z) < 3) >= 22


def test_a_truncated_file_is_used_up_to_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    status, lines, errors = replay(capsys, shared("truncated-30s.mcap"))
    assert status == 1
    assert len(errors.strip().splitlines()) == 1
    assert 15 < lines[-1]["summary"]["recorded_seconds"] < 30
    assert lines[-1]["summary"]["windows"]["used"] > 30


@pytest.mark.slow
def test_the_same_ride_as_mcap_and_as_can_gives_the_same_estimates(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The healthy recording, its values rounded as the CAN database does, written as CSV: MCAP against quantised."""
    from sprung.replay.record import load_record

    system = load_system()
    record = load_record(shared("healthy-120s.mcap"), system.channels, system.sample_rate)
    units = {"m/s^2": 0.002, "m/s": 2e-5, "m": 1e-6}
    steps = np.array([0.0005 if c.name.startswith("car") else units[c.unit] for c in system.channels])
    rounded = np.round(record.values / steps) * steps
    file = tmp_path / "rounded.csv"
    columns = ["time", *(c.name for c in system.channels)]
    time = record.start / 1e9 + np.arange(len(rounded)) / system.sample_rate
    np.savetxt(file, np.column_stack([time, rounded]), delimiter=",", header=",".join(columns), comments="", fmt="%.9f")
    text = (Path(__file__).parents[1] / "model" / "systems" / "manchester.yaml").read_text()
    named = tmp_path / "csv.yaml"
    for channel in system.channels:
        text = text.replace(f"can: {channel.can}", f"csv: {channel.name}")
    named.write_text(text)
    _, exact, _ = replay(capsys, shared("healthy-120s.mcap"))
    _, quantised, _ = replay(capsys, file, "--system", named)
    for a, b in zip(exact[-1]["summary"]["parameters"], quantised[-1]["summary"]["parameters"], strict=True):
        assert abs(a["value"] - b["value"]) < 0.5 * a["std"]
