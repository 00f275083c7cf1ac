"""The command line beside replays: help, pipes, interrupts, narrow terminals, export, doctor."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
from can import BusState
from mcap.reader import make_reader
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from sprung.model.system import MANCHESTER
from sprung.service.cli import describe, main
from sprung.service.cli.app import app
from sprung.service.cli.diagnose import text as text_of
from sprung.service.cli.doctor import _bus
from sprung.service.cli.parameters import parameter_table
from sprung.service.cli.replay import incomplete_line, measurement_lines, reporting_what_is_kept, slower_line
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.views import vehicle_view
from sprung.service.rendering.render import percent
from sprung.service.sources.feed import FeedResult
from sprung.service.store import open_store
from sprung.service.store.fleet import ensure_vehicle
from tests.report_made import friction_report

ROOT = Path(__file__).parents[3]
RIDE = ROOT / "tests" / "data" / "drift-600s.blf"
HEAD_ONLY = "set -o pipefail; {python} -m sprung replay {ride} --json | head -n 1"


def run(*arguments: str, stdin: bytes | None = None, columns: str = "120") -> subprocess.CompletedProcess[bytes]:
    environment = os.environ | {"COLUMNS": columns, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "sprung", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, input=stdin, capture_output=True, check=False)


@pytest.mark.parametrize(
    "command", ["replay", "serve", "export", "doctor", "diagnose", "train", "system", "simulate", "backup"]
)
def test_help_is_in_full_words(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    for machine in ("<bool>", "<path>", "<str>", "<Path>", "list[", "range>", "{FILE"):
        assert machine not in text
    lines = text.splitlines()
    for i, line in enumerate(lines[:-1]):  # what goes on in the next line stands below where it began
        began = re.match(r"  (\S+(?: [A-Z]+)?)  +(?=\S)", line)
        if began and re.match(r"   +\S", lines[i + 1]):
            assert len(lines[i + 1]) - len(lines[i + 1].lstrip()) == began.end(), lines[i : i + 2]


LONG = {
    "diagnose": ["--out", "--write-system", "--write-laws"],
    "train": ["--out"],
    "simulate": ["--out"],
    "compare": ["--out"],
    "inspect": ["--write-system"],
    "export": ["--out"],
    "bench": ["--out", "--folder"],
    "serve": ["--data-dir"],
}


@pytest.mark.parametrize(("command", "option"), [(c, option) for c, options in LONG.items() for option in options])
def test_what_cannot_be_written_is_reported_before_the_work(
    command: str, option: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    target = "/proc/nowhere/x.csv" if option == "--folder" else "/proc/x.csv"
    given: dict[str, list[str]] = {"serve": []}
    given |= {"bench": ["sensors" if option == "--folder" else "concealed"], "train": [], "export": ["a"]}
    given |= {"simulate": [str(MANCHESTER), "--inputs", str(RIDE)], "compare": [str(RIDE), str(RIDE)]}
    begun = time.monotonic()
    assert main([command, *given.get(command, [str(RIDE)]), option, target]) == 2
    told = capsys.readouterr()
    assert told.out == "" and len(told.err.splitlines()) == 1 and "cannot be written" in told.err
    assert time.monotonic() - begun < 10


def test_names_in_a_recording_are_no_markup_and_tell_a_terminal_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    path = tmp_path / "signals.csv"
    path.write_text("time,a [/b],\x1b[31mc\u202e\n" + "".join(f"{i / 100},{i},{i % 7}\n" for i in range(100)))
    assert main(["inspect", str(path)]) == 0
    told = capsys.readouterr().out
    assert "a [/b]" in told and r"\x1b[31mc\u202e" in told and "\x1b" not in told


@pytest.mark.parametrize("command", ["", "token"])
def test_a_command_without_its_command_shows_the_help_as_lines(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    told = capsys.readouterr()
    assert told.err == "" and told.out.startswith("Usage: sprung") and len(told.out.splitlines()) > 10


def test_wrong_usage_points_to_the_help_of_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay"]) == 2
    line = capsys.readouterr().err.strip()
    assert line.endswith("see sprung replay --help") and ".;" not in line


def test_what_is_no_usage_error_is_one_line() -> None:
    assert describe(ValueError("two\nlines")) == "two lines"


def test_a_store_that_cannot_be_written_is_named_and_why(tmp_path: Path) -> None:
    store = open_store(str(tmp_path / "s.db"))
    with pytest.raises(OperationalError) as caught, store.write() as connection:
        connection.execute(text("PRAGMA query_only = ON"))  # as a file without permission to write
        ensure_vehicle(connection, "v", 0)
    store.close()
    assert describe(caught.value) == f"store sqlite:///{tmp_path}/s.db: attempt to write a readonly database"


@pytest.mark.parametrize(
    ("name", "instead"), [("Zug 17/ä", "Zug_17__"), ("", "vehicle"), ("a\nb", "a_b"), ("x" * 300, "x" * 128)]
)
def test_a_name_that_no_vehicle_can_have_is_refused_with_one_that_it_can(
    name: str, instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["replay", str(RIDE)], ["serve", "--port", "0"], ["edge", str(RIDE)]):
        assert main([*command, "--vehicle", name]) == 2
        told = capsys.readouterr().err
        assert len(told.splitlines()) == 1 and told.startswith(f"sprung: --vehicle {name!r}: letters, digits")
        assert f"; {instead!r} would do" in told


def test_a_table_in_a_pipe_breaks_no_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    path, name = tmp_path / "signals.csv", "a very long name of a signal " * 5
    path.write_text(f"time,{name.strip()},b\n" + "".join(f"{i / 100},{i},{i % 7}\n" for i in range(100)))
    assert main(["inspect", str(path)]) == 0
    assert name.strip() in capsys.readouterr().out


def test_a_finding_is_told_once_unless_advice_hangs_on_it() -> None:
    report = friction_report()
    place = report.findings[0].location
    found = replace(report.findings[0], sentence=f"{place}: dry friction of 395 +- 6 N")
    told = text_of(replace(report, findings=(found,), summary=f"{found.sentence}; explains 99 %.")).splitlines()
    assert [line for line in told if "friction" in line] == [f"{place}: dry friction of 395 ± 6 N; explains 99 %."]
    advised = tuple(replace(found, sentence=f"{one} {found.sentence}", advice="look") for one in "ab")
    summary = "; ".join(one.sentence for one in advised)
    told = text_of(replace(report, findings=advised, summary=summary)).splitlines()
    assert [told[i - 1][:1] for i, line in enumerate(told) if line == "  look"] == ["a", "b"]


@pytest.mark.parametrize(("left", "said"), [(0.031, "3.0 % is noise"), (0.021, "no more than noise (3.0 %)")])
def test_noise_is_not_said_to_be_more_than_all_that_is_left(left: float, said: str) -> None:
    report = friction_report()
    after = replace(report.augmented_validation, nrmse=left)
    floor = replace(report.noise_floor, nrmse=0.03)
    assert text_of(replace(report, augmented_validation=after, noise_floor=floor)).splitlines()[-1].endswith(said)


def test_a_load_that_is_none_has_no_minus() -> None:
    assert measurement_lines({"load": {"car": [-0.3, 9.0]}}, {}) == ["load: car +0 ± 9 kg against nominal"]
    assert percent(-0.0001) == "+0.0 %"


def test_narrow_tables_keep_whole_names(engine: Engine) -> None:
    view = vehicle_view(engine, "a", engine.tracker.initial_state(), None)
    for width in (50, 64, 80, 120):
        table = parameter_table(view, width)
        heads = [str(column.header) for column in table.columns]
        assert heads[0] == "parameter" and {"drift", "state"} <= set(heads)
        assert ("nominal" in heads) == (width >= 84)


def test_wide_tables_state_how_well_a_drift_is_known(engine: Engine) -> None:
    view = vehicle_view(engine, "a", engine.tracker.initial_state(), None)
    first = replace(view.parameters[0], drift=-0.2983, drift_std=0.0012)
    view = replace(view, parameters=(first, *view.parameters[1:]))
    for width, shown in ((120, "-29.8 ± 0.1 %"), (80, "-29.8 %")):
        drift = next(column for column in parameter_table(view, width).columns if column.header == "drift")
        cells = [str(cell) for cell in drift.cells]
        assert cells[0] == shown and cells[1] == "–"


def test_doctor_tells_what_works_and_what_does_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--store", str(tmp_path / "s.db"), "--data-dir", str(tmp_path)]
    assert main(["doctor", *options]) == 0
    text = capsys.readouterr().out
    for what in ("installation", "model", "store", "disk", "clock"):
        assert f" {what}: " in text
    assert main(["doctor", *options, "--can", "socketcan:can9"]) == 1
    assert "failed   bus socketcan:can9" in capsys.readouterr().out
    (tmp_path / "broken.db").write_bytes(b"this is no database" * 100)
    assert main(["doctor", "--store", str(tmp_path / "broken.db"), "--data-dir", str(tmp_path)]) == 1


@pytest.mark.parametrize(
    ("system", "dbc", "status", "told"),
    [
        (None, None, 0, "ok       database: "),
        (None, "other.dbc", 1, "failed   database: channel "),
        (None, "absent.dbc", 1, "failed   database: "),
        ("other.yaml", None, 0, "warning  database: strut has 1 CAN signal; name one with --dbc"),
        ("other.yaml", "other.dbc", 0, "has the 1 CAN signal of strut"),
        ("tables.yaml", None, 0, "ok       database: none is needed"),
    ],
)
def test_doctor_says_whether_the_can_database_fits_the_vehicle(
    system: str | None, dbc: str | None, status: int, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "name: strut\nsample_rate: 100\nwindow: 100\nbodies:\n  body: {mass: 400}\n"
        "inputs:\n  road: {kind: support, displacement: {csv: z}}\n"
        "elements:\n  strut: {upper: body, lower: road, stiffness: 2.0e+4, damping: 1500}\n"
        "sensors:\n  top: {kind: acceleration, body: body, csv: a}\n"
    )
    (tmp_path / "tables.yaml").write_text(text)
    (tmp_path / "other.yaml").write_text(text.replace("csv: a", "can: Other.a"))
    (tmp_path / "other.dbc").write_text('VERSION ""\nBU_: X\nBO_ 1 Other: 8 X\n SG_ a : 0|16@1- (1,0) [0|0] "" X\n')
    options = ["--store", str(tmp_path / "s.db"), "--data-dir", str(tmp_path)]
    for option, name in (("--system", system), ("--dbc", dbc)):
        options += [] if name is None else [option, str(tmp_path / name)]
    assert main(["doctor", *options]) == status
    assert told in capsys.readouterr().out


def options_of(command: str) -> set[str]:
    """Of a command, as its help names them."""
    found: Any = typer.main.get_command(app)
    for name in command.split():
        found = found.commands[name]
    return {option for parameter in found.params for option in parameter.opts}


def test_commands_that_open_a_recording_take_the_same_options() -> None:
    one = ["replay", "serve", "edge", "diagnose", "simulate", "compare", "inspect"]
    for command in (*one, "train", "doctor", "fleet backfill", "fleet diagnose"):
        assert "--dbc" in options_of(command), command
        assert command == "simulate" or "--system" in options_of(command), command  # it is SYSTEM there
    for command in set(one) - {"inspect"}:  # which shows times as they are
        assert "--start" in options_of(command), command
    assert "--weights" in options_of("doctor") & options_of("edge") & options_of("serve") & options_of("replay")


def test_a_start_is_that_of_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start, ride = ["--start", "2026-09-21T14:13:20Z"], str(RIDE)
    for command in (
        ["serve", *start],
        ["serve", *start, "--replay", ride, "--replay", ride],
        ["edge", *start, "--server", "http://127.0.0.1:9", "--can", "virtual:x"],
    ):
        assert main([*command, "--data-dir", str(tmp_path)] if command[0] == "serve" else command) == 2
        assert "--start says when one recording began; give one FILE" in capsys.readouterr().err


def test_a_simulated_ride_begins_when_its_inputs_are_said_to_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "car.yaml").write_text(
        "name: strut\nsample_rate: 100\nwindow: 100\nbodies:\n  body: {mass: 400}\n"
        "inputs:\n  road: {kind: support, displacement: {csv: z}, velocity: {csv: w}}\n"
        "elements:\n  strut: {upper: body, lower: road, stiffness: 2.0e+4, damping: 1500}\n"
        "sensors:\n  top: {kind: acceleration, body: body, csv: a}\n"
    )
    rows = "\n".join(f"{i / 100:.2f},{math.sin(i / 9):.6f},{100 / 9 * math.cos(i / 9):.6f},0" for i in range(400))
    (tmp_path / "in.csv").write_text(f"time,z,w,a\n{rows}\n")
    car, given, made = (str(tmp_path / name) for name in ("car.yaml", "in.csv", "out.csv"))
    assert main(["simulate", car, "--inputs", given, "--out", made, "--start", "2026-09-21T14:13:20Z"]) == 0
    assert Path(made).read_text().splitlines()[1].startswith("1790000000.0")
    capsys.readouterr()
    assert main(["compare", given, made, "--system", car, "--start", "2026-09-21T14:13:21Z", "--json"]) == 0
    assert main(["compare", given, made, "--system", car, "--start", "noon"]) == 2
    assert main(["inspect", given, "--system", car, "--time-unit", "s"]) == 2
    assert "the system file says how times are read" in capsys.readouterr().err


def test_a_vehicle_s_frames_are_shown_with_its_database(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(RIDE), "--system", str(MANCHESTER), "--json"]) == 0
    named = {signal["address"].get("can") for signal in json.loads(capsys.readouterr().out)["signals"]}
    assert "CarAcceleration.CarAccelerationFrontLeft" in named


def test_export_of_an_unknown_vehicle_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "nobody", "--store", str(tmp_path / "s.db")]) == 2
    assert "s.db: there is none" in capsys.readouterr().err and not (tmp_path / "s.db").exists()
    open_store(str(tmp_path / "s.db")).close()
    assert main(["export", "nobody", "--store", str(tmp_path / "s.db")]) == 2
    assert "nothing is known of vehicle 'nobody'" in capsys.readouterr().err
    assert main(["export", "a", "--format", "xls"]) == 2
    assert main(["export", "a", "--since", "noon", "--store", str(tmp_path / "s.db")]) == 2


@pytest.mark.slow
def test_a_ride_from_stdin_and_out_again(tmp_path: Path) -> None:
    store = str(tmp_path / "s.db")
    done = run("replay", "-", "--store", store, "--vehicle", "car-17", stdin=RIDE.read_bytes(), columns="60")
    assert done.returncode == 1, done.stderr  # it has alarms
    assert b"secondary_2l.damping" in done.stdout and b"\xe2\x80\xa6" not in done.stdout
    out = run("export", "car-17", "--store", store)
    rows = list(csv.reader(io.StringIO(out.stdout.decode())))
    assert len(rows) == 1 + 1199 and len(rows[0]) == 3 + 48
    mcap = tmp_path / "h.mcap"
    run("export", "car-17", "--store", store, "--out", str(mcap), "--parameter", "secondary_2l.damping")
    with mcap.open("rb") as file:
        assert {c.topic for _, c, _ in make_reader(file).iter_messages()} == {"/estimate/secondary_2l/damping"}


@pytest.mark.slow
def test_a_closed_pipe_is_no_alarm() -> None:
    line = HEAD_ONLY.format(python=sys.executable, ride=RIDE)
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, check=False)
    assert done.returncode == 0 and done.stdout.startswith(b'{"window"'), done.stderr


@pytest.mark.slow
def test_an_interrupt_tells_what_is_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sprung", "replay", str(RIDE), "--store", str(tmp_path / "s.db"), "--speed", "2"]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        time.sleep(25)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert b"windows are kept in" in errors and b"call it again" in errors


def test_what_an_interrupt_left_does_not_depend_on_the_name_of_its_folder(capsys: pytest.CaptureFixture[str]) -> None:
    for url, told in (("sqlite:////srv/sprung-depot/s.db", "7 windows are kept in sqlite:"), (None, "nothing is kept")):
        with pytest.raises(KeyboardInterrupt), reporting_what_is_kept(Counter(windows=7), url):
            raise KeyboardInterrupt
        assert told in capsys.readouterr().err


def test_the_doctor_opens_a_bus_as_the_service_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, Any]] = []

    def opened(**options: Any) -> Any:
        asked.append(options)
        raise OSError("no such device")

    monkeypatch.setattr("can.Bus", opened)
    assert _bus("pcan:PCAN_USBBUS1,bitrate=250000,fd=true").state == "failed"
    assert asked == [
        {"interface": "pcan", "channel": "PCAN_USBBUS1", "bitrate": 250000, "fd": True, "state": BusState.PASSIVE}
    ]
    assert "name=value" in _bus("socketcan:can0,fast").text and "INTERFACE:CHANNEL" in _bus("can0").text
    assert len(asked) == 1


def test_a_free_body_is_a_legal_system(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["system", str(ROOT / "benchmarks" / "systems" / "emps.yaml")]) == 0
    assert "slide.mass" in capsys.readouterr().out


def test_a_replay_that_is_slower_than_asked_says_so() -> None:
    fed = FeedResult("a", recorded_seconds=100.0, wall_seconds=20.0)
    assert slower_line(fed, 60.0) == (
        "--speed 60 was asked for and 5 reached: this machine, busy as it is, is no faster"
    )
    assert slower_line(fed, 5.2) is None  # it kept up
    assert slower_line(fed, 0.0) is None  # as fast as possible


def test_what_a_recording_lost_is_counted_in_words() -> None:
    fed = FeedResult("a", Counter(used=8, repaired=1, dropped=1), Counter({"gap in x": 1}), late=2)
    assert incomplete_line(Path("a.mcap"), fed) == (
        "a.mcap: not monitored: 1 window repaired, 1 window dropped (gap in x: 1), 2 windows not tracked: older than "
        "what was known of a; 10 windows in all"
    )


def test_an_empty_standard_input_is_reported_by_every_command_that_takes_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("replay", "diagnose"):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
        assert main([command, "-"]) == 2
        assert "standard input is empty" in capsys.readouterr().err


def test_a_recording_from_standard_input_is_read_for_a_diagnosis(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"time,a\n0,1\n0.01,2\n")))
    assert main(["diagnose", "-"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("sprung: standard input: the system file names no columns")  # it came as far as those
    assert "stdin.csv" not in said
