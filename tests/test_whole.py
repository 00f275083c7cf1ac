"""The main job as its user does it: recordings in, drift out, with the trained model and nothing faked."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.generator import read_vehicle
from sprung.benchmarks.generator.files import WRITERS
from sprung.model.system import MANCHESTER
from sprung.service.cli import main
from tests.rides import RecordedRide, cut_off, make_ride, with_losses

DRIFT = Path(__file__).parent / "data" / "drift-600s.blf"
# What drifts in the bundled recording: parameter, share lost in the end, time constant (from 5 s before its start).
DRIFTING = (("secondary_2l.damping", 0.45, 250.0), ("primary_12r.stiffness", 0.2, 300.0))


def replay(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[dict[str, Any]], str]:
    status = main(["replay", *map(str, arguments), "--json"])
    captured = capsys.readouterr()
    return status, [json.loads(line) for line in captured.out.splitlines()], captured.err


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> RecordedRide:
    return make_ride(tmp_path_factory.mktemp("ride") / "healthy.mcap", 60.0, seed=5)


def within(summary: dict[str, Any], ride: RecordedRide) -> int:
    """Parameters of the 24 whose true value is less than three of their standard deviations off."""
    return sum(abs(p["value"] - ride.truth[p["name"]]) < 3 * p["std"] for p in summary["parameters"])


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
    ride: RecordedRide, capsys: pytest.CaptureFixture[str]
) -> None:
    status, lines, _ = replay(capsys, ride.path)
    summary = lines[-1]["summary"]
    assert status == 0
    assert summary["alarms"] == []
    assert summary["windows"]["used"] == 119
    assert within(summary, ride) >= 23


@pytest.mark.parametrize("kind", ["mcap", "blf"])
def test_losses_are_counted_and_told_in_one_line(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ride = with_losses(make_ride(tmp_path / f"whole.{kind}", 30.0, seed=6), tmp_path / f"lossy.{kind}")
    status, lines, errors = replay(capsys, ride.path)
    summary = lines[-1]["summary"]
    assert status == 1
    assert len(errors.strip().splitlines()) == 1
    assert "lost" in errors or "missing" in errors
    assert summary["frames"]["foreign"] == ride.foreign
    assert (ride.foreign > 0) == (kind == "blf")
    assert sum(summary["windows"].values()) >= 58
    assert all(line["reason"] for line in lines[:-1] if line["outcome"] != "used")
    assert within(summary, ride) >= 22


def test_a_truncated_file_is_used_up_to_its_end(
    ride: RecordedRide, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, lines, errors = replay(capsys, cut_off(ride, tmp_path / "truncated.mcap", 0.6).path)
    assert status == 1
    assert len(errors.strip().splitlines()) == 1
    assert 25 < lines[-1]["summary"]["recorded_seconds"] < 45
    assert lines[-1]["summary"]["windows"]["used"] > 50


def test_the_same_ride_as_mcap_and_as_can_gives_the_same_estimates(
    ride: RecordedRide, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A CAN database rounds the values."""
    vehicle = read_vehicle(MANCHESTER)
    quantised = tmp_path / "ride.blf"
    WRITERS["blf"](quantised, vehicle, ride.values, "")
    (_, exact, _), (_, rounded, _) = (replay(capsys, path) for path in (ride.path, quantised))
    for a, b in zip(exact[-1]["summary"]["parameters"], rounded[-1]["summary"]["parameters"], strict=True):
        assert abs(a["value"] - b["value"]) < 0.5 * a["std"]
