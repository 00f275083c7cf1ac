"""`sprung inspect`: what a recording holds, and the skeleton of a system file for it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sprung.model.schema import SupportInput
from sprung.model.signals import FloatArray
from sprung.model.system import load_system
from sprung.model.systemfile import read_system_file
from sprung.replay import UnreadableRecording
from sprung.replay.inspection import inspect, look
from sprung.replay.record import load_record
from sprung.service.cli import main
from tests.replay_files import database, write_can, write_json, write_protobuf, write_ros2

TIME = np.arange(6000) / 100.0


def write_columns(path: Path, columns: dict[str, FloatArray], separator: str = ",") -> None:
    rows = zip(*columns.values(), strict=True)
    path.write_text(separator.join(columns) + "\n" + "\n".join(separator.join(f"{v:.9g}" for v in r) for r in rows))


@pytest.fixture
def ride(tmp_path: Path) -> Path:
    """Ten seconds of standstill, then motion at 3 Hz; a repeated and a reversed channel; gaps and equal stamps."""
    rng = np.random.default_rng(5)
    moving = np.where(TIME >= 10.0, np.sin(2 * np.pi * 3 * TIME), 0.0)
    acceleration = 2.0 * moving + 0.01 * rng.standard_normal(len(TIME))
    time = TIME.copy()
    time[3001] = time[3000]
    columns = {
        "Time (ms)": 1000 * time,
        "Accel [g]": acceleration,
        "Copy [g]": acceleration,
        "Turned [g]": -acceleration,
        "Weg mm": 5.0 * moving,
        "off": np.zeros(len(TIME)),
    }
    keep = np.ones(len(TIME), dtype=bool)
    keep[4000:4150] = False
    write_columns(tmp_path / "ride.csv", {name: values[keep] for name, values in columns.items()})
    return tmp_path / "ride.csv"


def test_every_signal_is_described(ride: Path) -> None:
    found = inspect(ride)
    signals = {signal.name: signal for signal in found.signals}
    assert list(signals) == ["Accel [g]", "Copy [g]", "Turned [g]", "Weg mm", "off"]
    assert found.relative
    assert found.seconds == pytest.approx(59.99)
    accel = signals["Accel [g]"]
    assert (accel.unit, accel.samples, accel.missing) == ("g", 5850, 0)
    assert accel.rate == pytest.approx(100.0, rel=1e-3)
    assert accel.peak == pytest.approx(3.0, abs=0.05)
    assert accel.band is not None and accel.band[0] > 2.8 and accel.band[1] < 3.2
    assert accel.noise == pytest.approx(0.01, rel=0.1)
    assert (accel.gaps, accel.duplicate_times) == (1, 1)
    assert accel.longest_gap == pytest.approx(1.51)
    assert accel.standstill[0] == pytest.approx((0.0, 9.99), abs=0.02)
    assert len(accel.standstill) == 1
    assert (signals["Copy [g]"].same_as, signals["Turned [g]"].same_as) == ("Accel [g]", "-Accel [g]")
    assert signals["off"].constant
    assert signals["Weg mm"].unit is None


def test_noise_is_that_of_white_noise_beside_smooth_motion() -> None:
    rng = np.random.default_rng(7)
    value = 3.0 * np.sin(2 * np.pi * 2 * TIME) + 0.05 * rng.standard_normal(len(TIME))
    signal = look("x", {"column": "x"}, None, np.rint(TIME * 1e9).astype(np.int64), value, 0)
    assert signal.noise == pytest.approx(0.05, rel=0.1)
    rounded = look("x", {"column": "x"}, None, np.rint(TIME * 1e9).astype(np.int64), np.round(TIME % 1.0, 1), 0)
    assert rounded.noise == pytest.approx(0.1 / np.sqrt(12), rel=1e-6)


@pytest.mark.parametrize("write", [write_json, write_protobuf, write_ros2])
def test_mcap_of_every_encoding_is_listed_by_topic_and_field(tmp_path: Path, write: Callable[[Path], None]) -> None:
    write(tmp_path / "a.mcap")
    names = [signal.name for signal in inspect(tmp_path / "a.mcap").signals]
    assert names == ["/body/acceleration.left", "/body/acceleration.axes[0].right", "/body/acceleration.axes[1].right"]


def test_can_signals_are_listed_by_the_database_and_identifiers_without(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_can(tmp_path / "a.blf")
    found = inspect(tmp_path / "a.blf", database())
    assert [signal.address for signal in found.signals] == [{"can": "Body.Left"}, {"can": "Body.Right"}]
    with pytest.raises(UnreadableRecording, match=r"CAN identifiers \(.*0x310.*\); name the CAN database with --dbc"):
        inspect(tmp_path / "a.blf")
    assert main(["inspect", str(tmp_path / "a.blf")]) == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


def test_a_table_without_times_is_looked_at_by_samples_and_likely_times_are_named(tmp_path: Path) -> None:
    write_columns(tmp_path / "a.csv", {"counter": TIME, "x": np.sin(TIME)})
    found = inspect(tmp_path / "a.csv")
    assert [signal.name for signal in found.signals] == ["counter", "x"]
    assert found.problems[0].startswith("no column of times is recognised")
    assert "evenly rising, so perhaps a time: counter" in found.problems


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("Datum", "22.11.2026 12:00:{:06.3f}"),
        ("Date", "11/22/2026 12:00:{:06.3f}"),
        ("Uhrzeit", "12:00:{:06.3f}"),
        ("ts", "17953488{:012.9f}"),
    ],
)
def test_columns_of_times_are_known_by_name(tmp_path: Path, name: str, stamp: str) -> None:
    rows = [f"{stamp.format(x).replace(chr(46), '') if name == 'ts' else stamp.format(x)};{x:g}" for x in TIME[:500]]
    (tmp_path / "a.csv").write_text("\n".join([f"{name};d", *rows]))
    (signal,) = inspect(tmp_path / "a.csv").signals
    assert signal.name == "d" and signal.rate == pytest.approx(1 / (TIME[1] - TIME[0]), rel=1e-3)


def test_what_holds_no_plain_numbers_is_named(tmp_path: Path) -> None:
    rows = [f"{x:.2f};{x:.2f};1.{int(100 + x)},5".replace(".", ",", 2) for x in TIME[:200]]
    (tmp_path / "a.csv").write_text("\n".join(["time;d;F", *rows]))
    found = inspect(tmp_path / "a.csv")
    assert [signal.name for signal in found.signals] == ["d"]
    assert "left out, since they hold no plain numbers: F" in found.problems


def test_the_command_prints_a_table_remarks_and_json(ride: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(ride)]) == 0
    out, err = capfd.readouterr()
    assert f"{ride}: 59.99 s, times count from 0" in out.splitlines()
    assert "Turned [g]: is Accel [g] with the other sign" in out
    assert "Weg mm: stands still from 0 to 9.99 s" in out
    assert "off: always 0" in out
    assert err == ""
    assert main(["inspect", str(ride), "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    assert said["start"] is None
    assert said["signals"][0]["address"] == {"column": "Accel [g]"}
    assert set(said["signals"][0]) >= {"rate", "unit", "gaps", "minimum", "maximum", "band", "peak", "noise", "same_as"}


def test_a_skeleton_is_a_valid_system_file_that_reads_the_recording(
    ride: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.yaml"
    assert main(["inspect", str(ride), "--write-system", str(path)]) == 0
    system = load_system(path)
    assert [channel.table for channel in system.channels] == ["Accel [g]", "Weg mm"]
    assert [channel.unit for channel in system.channels] == ["m/s^2", "m"]
    assert system.channels[0].gain == 9.80665
    assert system.channels[0].noise == pytest.approx(0.01 * 9.80665, rel=0.2)
    record = load_record(ride, system.channels, system.sample_rate, time=system.time)
    assert np.nanmax(record.values[:, 0]) == pytest.approx(2 * 9.80665, rel=0.05)
    capfd.readouterr()
    assert main(["system", str(path)]) == 0
    assert main(["inspect", str(ride), "--write-system", str(path)]) == 2
    assert "exists already" in capfd.readouterr().err


def test_motion_and_force_alone_make_a_component_test(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_columns(
        tmp_path / "dyno.txt",
        {"T": 1000 * TIME, "Stroke, mm": np.sin(TIME), "Load, kN": np.cos(TIME)},
        separator="\t",
    )
    path = tmp_path / "dyno.yaml"
    arguments = ["inspect", str(tmp_path / "dyno.txt"), "--time-column", "T", "--time-unit", "ms"]
    assert main([*arguments, "--write-system", str(path)]) == 0
    file = read_system_file(path)
    assert file.bodies == {}
    assert file.elements["component"].lower == "ground"
    rod = file.inputs["rod"]
    assert isinstance(rod, SupportInput) and rod.displacement is not None
    assert (rod.displacement.unit, file.sensors["cell"].unit) == ("mm", "kN")
    assert (file.time.column, file.time.unit) == ("T", "ms")
    assert file.sample_rate == pytest.approx(100)  # friction shows within a cycle
    capfd.readouterr()
    assert main(["system", str(path)]) == 0
    assert "component test" in capfd.readouterr().out


@pytest.mark.parametrize(
    "commands", [("inspect",), pytest.param(("replay", "diagnose"), marks=pytest.mark.slow)], ids=" ".join
)
@pytest.mark.parametrize(
    "name", ["a.csv", "a.mat", "a.json", "a.uff", "a.mcap", "a.parquet", "a.h5", "a.tdms", "a.xyz"]
)
def test_what_cannot_be_read_is_one_line_and_exit_status_2(
    tmp_path: Path, name: str, commands: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    for content in (b"", b"neither this\nor that\n" * 30, bytes(range(256)) * 20):
        (tmp_path / name).write_bytes(content)
        for command in commands:
            assert main([command, str(tmp_path / name)]) == 2
            err = capfd.readouterr().err
            assert err.startswith(f"sprung: {tmp_path / name}: "), (command, err)
            assert len(err.splitlines()) == 1
            assert "unexpected" not in err


def test_wrong_options_are_one_line(ride: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for options, words in (
        (["--time-unit", "fortnight"], "known are s, ms"),
        (["--rate", "-1"], "must be greater than 0"),
        (["--time-column", "Time"], "no time column 'Time' (did you mean 'Time (ms)'?)"),
    ):
        assert main(["inspect", str(ride), *options]) == 2
        err = capfd.readouterr().err
        assert words in err
        assert len(err.splitlines()) == 1


def test_lost_rows_between_uneven_stamps_are_counted_and_do_not_lower_the_rate() -> None:
    rng = np.random.default_rng(8)
    kept = rng.random(20_000) > 0.02
    time = 1_790_000_000 + (np.arange(20_000) / 200 + rng.uniform(-1e-3, 1e-3, 20_000))[kept]
    value = np.sin(np.arange(20_000) / 30)[kept]
    stamps = np.rint((time - time[0]) * 1e9).astype(np.int64)
    found = look("a", {}, None, stamps, value, 0)
    assert found.rate == pytest.approx(200.0, rel=1e-5)
    assert found.lost == np.flatnonzero(kept)[-1] - np.flatnonzero(kept)[0] + 1 - kept.sum()
    assert found.jitter == pytest.approx(0.2 / np.sqrt(3), rel=0.05)  # even within a millisecond either way
    whole = look("a", {}, None, np.arange(20_000) * 5_000_000, np.sin(np.arange(20_000) / 30), 0)
    assert whole.lost == 0 and whole.rate == pytest.approx(200.0)


def test_names_of_a_skeleton_are_spelt_in_plain_letters(tmp_path: Path) -> None:
    path = tmp_path / "fahrt.csv"
    names = ["Straße z [µm]", "Größe à v [m/s]", "加速度 [g]", "力 [g]"]
    rows = [[i / 100, *(np.sin(i / (7 + k)) for k in range(4))] for i in range(500)]
    path.write_text("t;" + ";".join(names) + "\n" + "\n".join(";".join(f"{v:.6f}" for v in row) for row in rows))
    assert main(["inspect", str(path), "--write-system", str(tmp_path / "s.yaml")]) == 0
    sensors = list(load_system(tmp_path / "s.yaml").sensors)
    assert sensors[:2] == ["strasse_z_um", "groesse_a_v_m_s"] and len(set(sensors)) == 4


def test_a_start_without_a_zone_is_refused_with_two_that_have_one(
    ride: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(ride), "--start", "2026-09-21T14:13:20"]) == 2
    assert "with its zone" in capsys.readouterr().err
