"""What a diagnosis found goes back into the system file, and the next diagnosis starts from there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import (
    Finding,
    FitFigures,
    IdentifiedLaw,
    LawParameter,
    RecordingFacts,
    Report,
    ReportedParameter,
)
from sprung.model.schema import SupportInput
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import parse_system
from sprung.replay.writing import write_recording
from sprung.service.cli import main
from sprung.service.diagnosis.improved import improved_text, left_out

TEXT = """# my vehicle
name: quarter-car
sample_rate: 100
window: 100
bodies:
  wheel: {mass: 45}
  car: {mass: 400}  # empty
inputs:
  road:
    kind: displacement
    displacement: {csv: road, noise: 1.0e-5}
    velocity: {csv: rate, noise: 5.0e-4}
elements:
  tyre: {upper: wheel, lower: road, stiffness: 200000, damping: {value: 50, fixed: true}}
  strut: {upper: car, lower: wheel, stiffness: 18000, damping: 1800}
sensors:
  wheel_a: {kind: acceleration, body: wheel, csv: a, noise: 0.02}
  car_a: {kind: acceleration, body: car, csv: b, noise: 0.01}
  travel: {kind: deflection, element: strut, csv: d, noise: 2.0e-5}
"""


LAW = "{coulomb_friction: {force: 60, smoothing: {value: 0.01, fixed: true}}}"


def report(laws: tuple[IdentifiedLaw, ...], findings: tuple[Finding, ...] = ()) -> Report:
    figures = FitFigures(0.1, {})
    values = (ReportedParameter("strut.stiffness", 20123.4567, 10.0, 18000.0, "N/m"),)
    return Report(
        "quarter-car", RecordingFacts("a", 1.0, 100, 0), "missing_physics", values, figures, findings, values, figures,
        figures, {}, laws=laws, noise={"car_a": 0.0123, "road.velocity": 6e-4},
    )  # fmt: skip


def test_values_laws_and_noise_are_written_and_comments_stay() -> None:
    system = parse_system(TEXT)
    friction = IdentifiedLaw(
        "strut", "coulomb_friction",
        (LawParameter("force", 41.234567, 0.512, "N"), LawParameter("smoothing", 0.02, 0.001, "m/s")),
    )  # fmt: skip
    bias = IdentifiedLaw("car_a", "sensor_bias", (LawParameter("offset", 0.1, 0.01, "m/s^2"),))
    text = improved_text(TEXT, system, report((friction, bias)))
    assert "# my vehicle" in text and "# empty" in text
    again = parse_system(text)
    assert again.file.elements["strut"].stiffness.value == 20123.5
    assert [law.law.name for law in again.laws] == ["coulomb_friction", "sensor_bias"]
    assert again.laws[0].values == (41.2346, 0.02) and again.laws[0].std == (0.512, 0.001)
    assert again.laws[0].fixed == (False, True)  # the corner's width is not for single windows
    assert again.file.sensors["car_a"].noise == 0.0123
    road = again.file.inputs["road"]
    assert isinstance(road, SupportInput) and road.velocity is not None and road.velocity.noise == 6e-4
    assert again.file.elements["tyre"].damping.fixed
    # written again, laws are replaced and not doubled
    assert len(parse_system(improved_text(text, again, report((friction,)))).laws) == 2  # the bias stays: it was undone


def test_what_the_file_holds_fixed_stays_fixed() -> None:
    held = LAW.replace("force: 60", "force: {value: 60, fixed: true}")
    given = TEXT.replace("damping: 1800}", f"damping: 1800, laws: [{held}]}}")
    friction = IdentifiedLaw(
        "strut", "coulomb_friction",
        (LawParameter("force", 60.0, 0.06, "N"), LawParameter("smoothing", 0.01, 1e-5, "m/s")),
    )  # fmt: skip
    (law,) = parse_system(improved_text(given, parse_system(given), report((friction,)))).laws
    assert law.fixed == (True, True)


def test_what_no_file_can_hold_is_reported() -> None:
    friction = IdentifiedLaw("strut", "coulomb_friction", (LawParameter("force", 41.0, 0.5, "N"),))
    named = Finding("strut", "coulomb_friction", EffectKind.LISTED, (), 1e-9, -50.0)
    late = Finding("wheel_a|car_a", "node_delay", EffectKind.FAULT, (), None, None)
    noisy = Finding("wheel_a", "sensor_noise", EffectKind.FAULT, (LawParameter("ratio", 3.0, 0.1, "1"),), 1e-9, -50.0)
    assert left_out(report((friction,), (named, late, noisy))) == ["node delay at wheel_a and car_a"]


def test_files_that_cannot_be_written_are_reported_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "page").write_text("a file")
    for target in (["--write-system", str(tmp_path / "none" / "a.yaml")], ["--out", str(tmp_path / "page")]):
        assert main(["diagnose", str(tmp_path / "ride.csv"), *target]) == 2  # that recording is not even looked at
        told = capsys.readouterr().err
        assert target[1] in told and "ride.csv" not in told


def test_every_fault_of_a_measurement_stays_as_it_was_undone_before() -> None:
    rail = "  rail: {kind: displacement, displacement: {csv: rail, noise: 1.0e-5}}\n"
    pad = "  pad: {upper: wheel, lower: rail, stiffness: 1000, damping: 10}\n"
    late = TEXT.replace("elements:\n", f"{rail}elements:\n{pad}")
    late = late.replace("noise: 5.0e-4}", "noise: 5.0e-4}\n    laws: [{axle_delay: {time: 0.002, with: rail}}]")
    again = parse_system(improved_text(late, parse_system(late), report(())))
    assert [law.law.name for law in again.laws] == ["axle_delay"]


def test_noise_that_was_found_higher_is_no_law() -> None:
    noisy = Finding("wheel_a", "sensor_noise", EffectKind.FAULT, (LawParameter("ratio", 3.0, 0.1, "1"),), 1e-9, -50.0)
    again = parse_system(improved_text(TEXT, parse_system(TEXT), report((), (noisy,))))
    assert again.laws == () and again.file.sensors["wheel_a"].noise == pytest.approx(0.06)


def test_the_loop_is_closed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """diagnose -> improved file -> diagnose: friction found, then nothing is left."""
    system = parse_system(TEXT.replace("damping: 1800}", f"damping: 1800, laws: [{LAW}]}}"))
    rng, rate, samples = np.random.default_rng(5), 100.0, 2500
    t = np.arange(samples) / rate
    f, phase = rng.uniform(0.5, 12, 60), rng.uniform(0, 6.3, 60)
    road = (2e-3 / f * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    speed = (4e-3 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    truth = np.stack([road, speed], axis=1)
    ride = simulate_ride(system, truth, {"strut.stiffness": 20000.0, "strut.damping": 1500.0}, noise=rng)
    measured = truth + rng.normal(0, [1e-5, 5e-4], truth.shape)
    write_recording(tmp_path / "ride.csv", system.channels, np.hstack([measured, ride.sensors]), rate, 10**18)
    (tmp_path / "plain.yaml").write_text(TEXT)
    improved = tmp_path / "improved.yaml"
    command = ["diagnose", str(tmp_path / "ride.csv"), "--json", "--system"]
    assert main([*command, str(tmp_path / "plain.yaml"), "--write-system", str(improved)]) == 1
    first = json.loads(capsys.readouterr().out)
    assert [f["effect"] for f in first["findings"]] == ["coulomb_friction"]
    assert main([*command, str(improved)]) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["verdict"] == "consistent" and second["findings"] == []
    (law,) = second["laws"]
    assert law["parameters"][0]["value"] == pytest.approx(60, abs=4 * law["parameters"][0]["std"])
    stiffness = next(p for p in second["baseline"]["parameters"] if p["name"] == "strut.stiffness")
    assert stiffness["value"] == pytest.approx(20000, abs=4 * stiffness["std"])


def test_a_replay_with_a_law_in_the_file_tells_its_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = TEXT.replace("damping: 1800}", f"damping: 1800, laws: [{LAW}]}}")
    system = parse_system(text)
    rng, t = np.random.default_rng(6), np.arange(800) / 100.0
    f, phase = rng.uniform(0.5, 12, 60), rng.uniform(0, 6.3, 60)
    road = (2e-3 / f * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    speed = (4e-3 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    truth = np.stack([road, speed], axis=1)
    ride = simulate_ride(system, truth, {"strut.stiffness": 20000.0, "strut.damping": 1500.0}, noise=rng)
    measured = truth + rng.normal(0, [1e-5, 5e-4], truth.shape)
    write_recording(tmp_path / "ride.csv", system.channels, np.hstack([measured, ride.sensors]), 100.0, 10**18)
    (tmp_path / "car.yaml").write_text(text)
    assert main(["replay", str(tmp_path / "ride.csv"), "--system", str(tmp_path / "car.yaml"), "--json"]) == 0
    *windows, last = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert all("strut.coulomb_friction.force" in window["estimate"] for window in windows)
    found = {p["name"]: p for p in last["summary"]["parameters"]}["strut.coulomb_friction.force"]
    assert found["value"] == pytest.approx(60, abs=4 * found["std"]) and found["unit"] == "N"
