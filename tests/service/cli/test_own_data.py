"""From somebody's own file to the right result: other units, signs, separators, rates and times."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.model.system import parse_system
from sprung.replay.record import load_record
from sprung.service.cli import main
from tests.test_system import QUARTER_CAR

DOCS = Path(__file__).parents[3] / "docs"
TRUTH = {"tyre.stiffness": 1.9e5, "strut.stiffness": 1.85e4, "strut.damping": 1190.0}
RATE, SECONDS = 1000.0, 20.0

OWN = """
name: quarter-car
sample_rate: 200
window: 200
inputs:
  road:
    kind: support
    displacement: {csv: "Weg [mm]", unit: mm, noise: 1e-5}
    velocity: {csv: vz, unit: in/s, noise: 1e-3}
bodies:
  sprung: {mass: 300.0}
  unsprung: {mass: 40.0}
elements:
  tyre: {upper: unsprung, lower: road, stiffness: 1.8e5, damping: {value: 100.0, fixed: true}}
  strut: {upper: sprung, lower: unsprung, stiffness: 2.0e4, damping: 1500.0}
sensors:
  body: {kind: acceleration, body: sprung, column: Aufbau, unit: g, sign: -1, noise: 0.01}
  wheel: {kind: acceleration, body: unsprung, column: Rad, unit: V, scale: 50, offset: -75, noise: 0.05}
  travel: {kind: deflection, element: strut, column: Federweg, unit: mm, offset: 12, noise: 1e-5}
  load: {kind: force, element: strut, column: Kraft, unit: kN, noise: 1.0}
"""


def quarter_car(seed: int = 1) -> FloatArray:
    """Inputs and sensors in SI at 1 kHz: the steady response to a periodic random road, exact in frequency."""
    system = parse_system(QUARTER_CAR)
    A, B, C, D = system.mechanics.matrices(
        np.array([TRUTH["tyre.stiffness"], TRUTH["strut.stiffness"]]), np.array([100.0, TRUTH["strut.damping"]])
    )
    samples = round(RATE * SECONDS)
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    shape = np.where((frequency > 0.3) & (frequency < 60), np.maximum(frequency, 0.5) ** -1.2, 0.0)
    road = np.fft.rfft(rng.standard_normal(samples)) * shape * np.exp(-((frequency / 30) ** 4))
    road *= 0.01 / np.fft.irfft(road, samples).std()
    s = 2j * np.pi * frequency
    drive = np.stack([road, s * road], axis=1)
    transfer = C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B.astype(complex)) + D
    out = np.fft.irfft(np.c_[drive, (transfer @ drive[:, :, None])[:, :, 0]], samples, axis=0)
    return out + rng.standard_normal(out.shape) * [1e-5, 1e-3, 0.01, 0.05, 1e-5, 1.0]


def write_own(path: Path) -> None:
    """As an amplifier writes it: milliseconds, millimetres, inches, g, volts, kN, semicolons and decimal commas."""
    z, vz, body, wheel, travel, load = quarter_car().T
    columns = {
        "Zeit [ms]": 1000 * np.arange(len(z)) / RATE,
        "Weg [mm]": 1000 * z,
        "vz": vz / 0.0254,
        "Aufbau": -body / 9.80665,
        "Rad": wheel / 50 + 1.5,
        "Federweg": 1000 * travel - 12,
        "Kraft": load / 1000,
    }
    rows = (";".join(f"{v:.8g}" for v in row).replace(".", ",") for row in zip(*columns.values(), strict=True))
    path.write_text("# Messfahrt 7\n" + ";".join(columns) + "\n" + "\n".join(rows) + "\n", encoding="utf-8")


def test_a_ride_in_other_units_at_another_rate_gives_the_true_values(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_own(tmp_path / "ride.csv")
    (tmp_path / "own.yaml").write_text(OWN)
    options = ["--system", str(tmp_path / "own.yaml"), "--start", "2026-09-21T14:00:00Z", "--json"]
    assert main(["replay", str(tmp_path / "ride.csv"), *options]) == 0
    out, err = capfd.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    summary = lines[-1]["summary"]
    assert lines[0]["window"].startswith("2026-09-21T14:00:00")
    assert summary["windows"]["used"] > 35
    assert summary["windows"]["dropped"] == 0
    for parameter in summary["parameters"]:
        truth = TRUTH[parameter["name"]]
        assert parameter["value"] == pytest.approx(truth, rel=2e-3), parameter
        assert abs(parameter["value"] - truth) < 4 * parameter["std"]
    for said in (
        "the decimal sign is a comma",
        "taken to be 2026-09-21 14:00:00 UTC",
        "6 channels: 1000 Hz reduced to 200 Hz",
    ):
        assert said in err


def test_a_second_ride_that_begins_at_0_is_tracked_on(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_own(tmp_path / "ride.csv")
    (tmp_path / "own.yaml").write_text(OWN)
    options = ["--system", str(tmp_path / "own.yaml"), "--store", str(tmp_path / "a.db"), "--vehicle", "car", "--json"]
    for start in ("2026-09-21T14:00:00Z", "2026-09-22T08:00:00Z"):
        assert main(["replay", str(tmp_path / "ride.csv"), "--start", start, *options]) == 0
        lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
        assert lines[-1]["summary"]["windows"]["used"] > 35
        assert lines[-1]["summary"]["fitting"]["untracked"] == 0
    assert main(["replay", str(tmp_path / "ride.csv"), "--start", "noon", *options]) == 2
    assert "a time with its zone is expected, such as 2026-09-21T14:13:20Z" in capfd.readouterr().err
    two = [str(tmp_path / "ride.csv")] * 2
    assert main(["replay", *two, "--start", "2026-09-23T08:00:00Z", *options]) == 2
    assert "give one FILE with it" in capfd.readouterr().err


def test_another_ride_that_begins_at_0_at_the_same_file_time_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """As when several are copied or unpacked at once.  The same one again is the same ride."""
    (tmp_path / "own.yaml").write_text(OWN)
    write_own(tmp_path / "monday.csv")
    lines = (tmp_path / "monday.csv").read_text().splitlines(keepends=True)
    (tmp_path / "tuesday.csv").write_text("".join(lines[:-100]))
    options = ["--system", str(tmp_path / "own.yaml"), "--store", str(tmp_path / "a.db"), "--vehicle", "car", "--json"]

    def replay(name: str, changed: float, *more: str) -> int:
        os.utime(tmp_path / name, (changed, changed))
        return main(["replay", str(tmp_path / name), *more, *options])

    assert replay("monday.csv", 1_790_000_000) == 0
    for later in (0, 2):
        assert replay("tuesday.csv", 1_790_000_000 + later) == 2
        err = capfd.readouterr().err
        assert "there is monday.csv of car already; say when it began" in err
    assert replay("monday.csv", 1_790_000_000) == 0
    capfd.readouterr()
    assert replay("tuesday.csv", 1_790_000_000, "--start", "2026-09-22T08:00:00Z") == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["summary"]["fitting"]["untracked"] == 0


def test_times_in_ms_that_nobody_declared_are_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    time = np.arange(3000) * 10
    rows = "\n".join(f"{t},{np.sin(t / 100):.6f},0,0,0,0,0" for t in time)
    (tmp_path / "ride.csv").write_text("time,z,vz,a1,a2,travel,load\n" + rows + "\n")
    (tmp_path / "car.yaml").write_text(QUARTER_CAR)
    for command in ("replay", "diagnose"):
        assert main([command, str(tmp_path / "ride.csv"), "--system", str(tmp_path / "car.yaml")]) == 2
        err = capfd.readouterr().err
        assert "if its times are in ms, set `time: {unit: ms}` in the system file" in err
        assert len(err.splitlines()) == 1


def test_the_example_of_the_documents_works(tmp_path: Path) -> None:
    text = (DOCS / "own-data.md").read_text(encoding="utf-8")
    written = re.search(r"```\n(# Versuch.*?)\.\.\.\n```", text, re.DOTALL)
    described = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert written and described
    head, system = written[1], parse_system(described[1])
    time = np.arange(2, 2000) * 0.5
    rows = "".join(f"{t};{20 * np.sin(t / 100):.3f};{np.cos(t / 100):.3f}\n".replace(".", ",") for t in time[:-1])
    (tmp_path / "versuch7.csv").write_text(head + rows, encoding="utf-8")
    record = load_record(tmp_path / "versuch7.csv", system.channels, system.sample_rate, time=system.time)
    grid = record.start / 1e9 + np.arange(len(record.values)) / 200.0
    assert np.allclose(record.values[:, 0], 0.02 * np.sin(10 * grid), atol=2e-5)
    assert np.allclose(record.values[:, 1], 1000 * np.cos(10 * grid), atol=2.0)
    assert record.lost == 0
