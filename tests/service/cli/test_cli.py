"""The command line: exit status, one-line errors, JSON lines as in the contract, tables for people."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks import BENCHMARKS
from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.identification.amortised.estimator import Estimator, new_estimator
from sprung.model.system import MANCHESTER, System
from sprung.service.cli import describe, main
from sprung.service.cli.app import app
from sprung.service.cli.bench import parse
from sprung.service.cli.fleet_commands import fleet
from sprung.service.cli.store_commands import token
from sprung.service.errors import UserError
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.settings import Settings, settings_with
from tests.diagnosis_cases import simulate
from tests.service_fakes import START, FakeIdentifier

SECONDS = 40


@pytest.fixture(autouse=True)
def fake_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands load a fake identifier; the real one has tests and benchmarks of its own."""

    def load(settings: Settings) -> Engine:
        from sprung.model.system import load_system

        system = load_system(settings.system or MANCHESTER)
        return Engine(system, FakeIdentifier(system), make_tracker(system), settings.dbc)

    monkeypatch.setattr("sprung.service.cli.replay.load_engine", load)
    for name in list(os.environ):
        if name.startswith("SPRUNG_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("SPRUNG_ISOLATE_READING", "false")  # a process for every file costs two seconds


@pytest.fixture
def csv_system(tmp_path: Path) -> Path:
    """The Manchester system with its signals in the columns of a CSV file."""
    path = tmp_path / "manchester-csv.yaml"
    path.write_text(MANCHESTER.read_text().replace("can: ", "csv: "))
    return path


def write(path: Path, system: System, level: Any, rows: range | list[int] = range(100 * SECONDS)) -> Path:
    """A recording in which every channel is `level(row)`."""
    with open(path, "w", newline="") as target:
        writer = csv.writer(target)
        writer.writerow(["time", *(channel.can for channel in system.channels)])
        for row in rows:
            writer.writerow([f"{START / 1e9 + row / 100:.3f}", *[level(row)] * len(system.channels)])
    return path


@pytest.fixture
def healthy(tmp_path: Path, system: System) -> Path:
    return write(tmp_path / "healthy.csv", system, lambda _: 0.01)


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def test_replay_prints_a_line_per_window_and_a_summary(
    healthy: Path,
    csv_system: Path,
    system: System,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("SPRUNG_ISOLATE_READING")  # as users have it: the file is read in a process of its own
    assert main(["replay", str(healthy), "--system", str(csv_system), "--json"]) == 0
    captured = capsys.readouterr()
    *windows, last = lines(captured.out)
    assert captured.err == ""
    assert len(windows) == 2 * SECONDS - 1
    names = [p.name for p in system.parameters]
    first = windows[0]
    assert first["window"] == "2026-09-21T14:13:20.000Z"
    assert (first["outcome"], first["reason"]) == ("used", None)
    assert first["fit"]["nrmse"] == 0.03
    assert list(first["estimate"]) == list(first["posterior"]) == names
    value, std = first["estimate"]["primary_11l.stiffness"]
    assert value == pytest.approx(1.22e6 * 1.01005, rel=1e-4)
    assert std == pytest.approx(0.01 * value)
    summary = last["summary"]
    assert summary["vehicle"] == "healthy"
    assert summary["windows"] == {"used": 79, "repaired": 0, "dropped": 0}
    assert summary["frames"] == {"used": 4000, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 0}
    assert [p["name"] for p in summary["parameters"]] == names
    assert {"value", "std", "unit", "nominal", "ratio", "identifiable"} <= set(summary["parameters"][0])
    assert summary["alarms"] == []
    assert summary["recorded_seconds"] == pytest.approx(SECONDS)
    assert summary["wall_seconds"] > 0


def test_a_recording_of_the_future_is_told_to_machines_and_people(
    healthy: Path, csv_system: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.sources.feed.now_ns", lambda: START - 86_400 * 10**9)
    assert main(["replay", str(healthy), "--system", str(csv_system), "--json"]) == 0
    captured = capsys.readouterr()
    (problem,) = lines(captured.out)[-1]["summary"]["problems"]
    assert "in the future" in problem and problem in captured.err


def test_replay_shows_a_table_for_people(healthy: Path, csv_system: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(healthy), "--system", str(csv_system)]) == 0
    out = capsys.readouterr().out
    assert out.count("primary_") == 16 and out.count("secondary_") == 8
    assert "79 used" in out
    assert "\x1b" not in out  # no colours in a pipe


def test_a_changed_vehicle_is_exit_status_one_with_its_alarms(
    tmp_path: Path, csv_system: Path, system: System, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "worn.csv", system, lambda row: 0.2 if row >= 3500 else 0.0, range(6000))
    assert main(["replay", str(path), "--system", str(csv_system), "--json"]) == 1
    alarms = lines(capsys.readouterr().out)[-1]["summary"]["alarms"]
    assert {a["parameter"] for a in alarms} == {"*.stiffness", "*.damping"}  # all at once is one message a kind
    for alarm in alarms:
        assert set(alarm) >= {"parameter", "onset", "change", "std", "severity"}
        assert alarm["onset"].startswith("2026-09-21T14:13:5")
        assert alarm["change"] == pytest.approx(0.2214, abs=0.02)


def test_a_recording_with_losses_is_exit_status_one_and_one_line(
    tmp_path: Path, csv_system: Path, system: System, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [row for row in range(2000) if not 500 <= row < 600]
    path = write(tmp_path / "lossy.csv", system, lambda _: 0.01, rows)
    assert main(["replay", str(path), "--system", str(csv_system), "--json"]) == 1
    captured = capsys.readouterr()
    summary = lines(captured.out)[-1]["summary"]
    assert summary["windows"]["dropped"] >= 2
    assert summary["samples"]["lost"] == pytest.approx(28 * 100, rel=0.02)
    assert len(captured.err.splitlines()) == 1
    assert f"{summary['samples']['lost']} of {summary['samples']['expected']} samples lost" in captured.err


def test_a_vehicle_that_was_not_monitored_is_not_called_well_in_the_table(
    tmp_path: Path, csv_system: Path, system: System, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "lossy.csv", system, lambda _: 0.01, range(2000))
    rows = list(csv.reader(path.read_text().splitlines()))
    missing = {channel.can for channel in system.channels[-8:]}  # accelerometers, 29 % of the samples
    kept = [i for i, name in enumerate(rows[0]) if name not in missing]
    with open(path, "w", newline="") as target:
        csv.writer(target).writerows([row[i] for i in kept] for row in rows)
    assert main(["replay", str(path), "--system", str(csv_system)]) == 1
    told = capsys.readouterr()
    assert "not monitored" in told.err and told.out.startswith("lossy: check function")


def test_replaying_into_a_store_twice_gives_the_same_lines_and_stores_nothing_twice(
    healthy: Path, csv_system: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["replay", str(healthy), "--system", str(csv_system), "--json", "--store", str(tmp_path / "s.db")]
    assert main(command) == 0
    first = lines(capsys.readouterr().out)
    assert main(command) == 0
    second = lines(capsys.readouterr().out)
    for one in (first, second):
        one[-1]["summary"].pop("wall_seconds")
    assert first == second


def test_without_a_store_a_run_depends_on_its_file_alone(
    healthy: Path, csv_system: Path, tmp_path: Path, system: System, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write(tmp_path / "other.csv", system, lambda _: 0.3)
    options = ["--system", str(csv_system), "--json", "--vehicle", "same"]
    main(["replay", str(healthy), *options])
    alone = lines(capsys.readouterr().out)[-1]["summary"]["parameters"]
    main(["replay", str(other), *options])
    capsys.readouterr()
    main(["replay", str(healthy), *options])
    assert lines(capsys.readouterr().out)[-1]["summary"]["parameters"] == alone


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", "no-such-file.blf"],
        ["replay"],
        ["replay", "pyproject.toml"],
        ["replay", "--colour", "x.blf"],
        ["nonsense"],
        ["serve", "--port", "99999"],
        ["serve", "--replay", "no-such-file.blf"],
        ["serve", "--can", "can0", "--port", "0"],
        ["system", "no-such-file.yaml"],
        ["system", "pyproject.toml"],
        ["diagnose", "no-such-file.blf"],
        ["bench", "nonsense"],
        ["replay", "tests/data/drift-600s.blf", "--store", "mysql://x/y"],
        ["replay", "tests/data/drift-600s.blf", "--system", "no-such-file.yaml"],
    ],
)
def test_what_cannot_be_done_is_one_line_and_exit_status_two(
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(Path(__file__).parents[3])
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(tmp_path))
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith("sprung: ")
    assert "Traceback" not in captured.err


@pytest.mark.parametrize("command", [["replay"], ["inspect"], ["diagnose"], ["serve", "--replay"]])
def test_a_pipe_is_refused_rather_than_waited_for(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(tmp_path / "data"))
    os.mkfifo(tmp_path / "ride.csv")
    assert main([*command, str(tmp_path / "ride.csv")]) == 2
    assert "ride.csv: is no file; " in capsys.readouterr().err


def test_diagnose_prints_the_report_and_leaves_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    system, recording = tmp_path / "quarter-car.yaml", tmp_path / "ride.csv"
    system.write_text(SYSTEM)
    rows = simulate(lambda d, v: 300 * np.tanh(v / 0.002), seed=21).values
    time = np.arange(len(rows))[:, None] / 100
    np.savetxt(
        recording, np.hstack([time, rows]), delimiter=",", header="time,d,v,a,b,e,f", comments="", fmt="%.9g"
    )  # fmt: skip
    options = ["--system", str(system), "--out", str(tmp_path / "out"), "--name", "Monday", "--json"]
    assert main(["diagnose", str(recording), *options]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["recording"]["file"] == "Monday"
    assert [(f["location"], f["effect"]) for f in report["findings"]] == [("secondary", "coulomb_friction")]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Monday" in page and 'src="http' not in page and 'href="http' not in page


def test_a_setting_that_cannot_be_is_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPRUNG_BATCH_WINDOWS", "many")
    assert main(["replay", __file__]) == 2
    assert "SPRUNG_BATCH_WINDOWS" in capsys.readouterr().err


@pytest.mark.parametrize("given", ["10.0.0.2,172.16.0.0/12", "10.0.0.2 172.16.0.0/12", '["10.0.0.2", "172.16.0.0/12"]'])
def test_lists_are_separated_by_commas_everywhere(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("trusted_proxies", "webhook_networks", "allowed_hosts", "webhooks", "mail_to"):
        monkeypatch.setenv(f"SPRUNG_{name.upper()}", given)
    settings = settings_with({})
    assert settings.trusted_proxies == settings.webhook_networks == settings.mail_to == ("10.0.0.2", "172.16.0.0/12")
    assert settings.allowed_hosts == settings.webhooks == settings.mail_to


def test_a_setting_that_is_nearly_one_is_told(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SPRUNG_OPNE", "SPRUNG_DATA_DIR", "SPRUNG_DEBUG", "SPRUNG_SERVICE_HOST", "SPRUNG_PORT_8000_TCP"):
        monkeypatch.setenv(name, "x")
    settings_with({})
    assert [record.getMessage() for record in caplog.records] == [
        "SPRUNG_OPNE is no setting; did you mean SPRUNG_OPEN?"
    ]


def test_an_unexpected_error_is_one_line_too() -> None:
    assert describe(RuntimeError("a\nb")) == "unexpected RuntimeError: a b; SPRUNG_DEBUG=1 shows where"


def test_memory_that_is_not_to_be_had_is_said_in_plain_words() -> None:
    assert describe(MemoryError()) == "out of memory"
    assert describe(MemoryError("Unable to allocate 4 GiB")) == "out of memory: Unable to allocate 4 GiB"
    assert describe(RuntimeError("can't start new thread")) == "out of memory: can't start new thread"
    told = "libtorch_cpu.so: failed to map segment from shared object"
    assert describe(ImportError(told)) == f"out of memory: {told}"


@pytest.mark.skipif(sys.platform != "linux", reason="address space is bounded on Linux")
@pytest.mark.parametrize(
    ("command", "told"),
    [("serve", "(`ulimit -v`) allows 512 MB of address space, and 1450 MB are needed"), ("system", "")],
)
def test_too_little_memory_to_start_is_told_in_one_line(tmp_path: Path, command: str, told: str) -> None:
    script = f"ulimit -v 500000; exec {shlex.quote(sys.executable)} -m sprung {command}"
    environment = os.environ | {"SPRUNG_DATA_DIR": str(tmp_path)}
    done = subprocess.run(
        ["bash", "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2 and done.stderr.startswith("sprung: out of memory: ") and told in done.stderr
    assert done.stderr.count("\n") == 1 and not done.stdout and "unexpected" not in done.stderr


def test_help_and_version_are_exit_status_zero(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sprung 0.")
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(command in out for command in ("replay", "serve", "train", "diagnose", "system", "bench"))
    assert "completion" in out


@pytest.mark.parametrize("group", [[], ["fleet"], ["token"]])
def test_help_describes_every_command_in_one_line_of_80_columns(
    group: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*group, "--help"]) == 0
    commands = capsys.readouterr().out.partition("Commands:")[2].strip().splitlines()
    assert len(commands) > 3
    assert all(line.startswith("  ") or number == 0 for number, line in enumerate(commands))
    assert all(line.endswith(".") and not line.endswith("...") for line in commands)


def test_help_of_every_command_names_no_python_types(capsys: pytest.CaptureFixture[str]) -> None:
    groups = {(): app, ("fleet",): fleet, ("token",): token}
    for group, commands in groups.items():
        for command in commands.registered_commands:
            assert command.callback is not None
            assert main([*group, command.name or command.callback.__name__, "--help"]) == 0
            assert not re.search(r"<(int|str|float|bool|path|list|url)|^Usage:.*\{", capsys.readouterr().out, re.I)


def test_bench_without_a_name_lists_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench"]) == 0
    assert {"identify", "replay", "serve", "drift"} <= {
        line.split()[0] for line in capsys.readouterr().out.splitlines()
    }


def test_options_of_a_benchmark_are_those_of_its_function() -> None:
    def run(task: str = "x", *, budget: str = "quick", seed: int = 1, data: Path | None = None) -> None: ...

    assert parse("b", run, ["y", "--budget", "full", "--seed=7"]) == (["y"], {"budget": "full", "seed": 7})
    wrongs = (["--speed", "1"], ["--seed", "x"], ["--seed"], ["--seed="], ["a", "b"], ["--seed", "--data", "d"])
    for wrong in (*wrongs, ["a", "--task", "b"], ["--seed", "1", "--seed", "2"]):
        with pytest.raises(UserError, match="bench b"):
            parse("b", run, wrong)


def test_a_benchmark_names_what_it_needs_and_describes_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "silverbox"]) == 2
    assert capsys.readouterr().err == "sprung: bench silverbox needs --data PATH; see sprung bench silverbox --help\n"
    assert main(["bench", "sensitivity", "--budget", "all"]) == 2
    assert capsys.readouterr().err.endswith("give quick or cases or full\n")
    assert main(["bench", "decode", "--can", "x.blf"]) == 2
    assert capsys.readouterr().err == "sprung: bench decode: --can and --dbc belong together\n"
    assert main(["bench", "shaken", "--rigs", "nonsense"]) == 2
    assert capsys.readouterr().err.startswith("sprung: bench shaken: nothing is measured with these arguments")
    assert main(["bench", "naming", "--motions", "sine,nonsense"]) == 2
    assert "'nonsense'" in capsys.readouterr().err
    for asked in (["silverbox", "--help"], ["silverbox", "-h"], ["silverbox", "somewhere", "--help"]):
        assert main(["bench", *asked]) == 0
        out = capsys.readouterr().out
        assert out.startswith("Usage: sprung bench silverbox --data PATH [--out PATH]\n")
        assert "--data PATH  required" in out and "missing physics" in out
    for asked in (["--help"], ["-h"], ["--help", "silverbox"]):
        assert main(["bench", *asked]) == 0
        assert "sprung bench NAME --help" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_has_a_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", name, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"Usage: sprung bench {name}") and "Options:" in out


def sprung(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    """The real command in a process of its own, which heeds Ctrl-C even where these tests run in the background."""
    return subprocess.Popen(
        [sys.executable, "-m", "sprung", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL) and None,  # noqa: PLW1509
        **options,
    )


def test_the_service_starts_answers_and_stops_when_told(tmp_path: Path) -> None:
    with sprung("serve", "--port", "0", "--data-dir", str(tmp_path)) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            address = line.split(" on ")[1].split()[0]
            deadline = time.monotonic() + 30
            while True:
                try:
                    with urllib.request.urlopen(f"{address}/health/ready", timeout=5) as answer:
                        assert answer.status == 200
                    break
                except OSError:
                    assert time.monotonic() < deadline
                    time.sleep(0.1)
        finally:
            process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    (told,) = errors.splitlines()
    assert "no token" in told and "sprung token create" in told
    assert not list(tmp_path.glob("*.db-wal"))


def test_a_port_in_use_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import socket

    monkeypatch.setattr("sprung.service.cli.serve.set_up", lambda form, level: None)  # logs are this process's
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert main(["serve", "--port", port, "--data-dir", str(tmp_path)]) == 2
    errors = capsys.readouterr().err
    assert port in errors and len(errors.splitlines()) == 1


def test_interrupting_a_replay_keeps_what_was_stored(tmp_path: Path) -> None:
    store = tmp_path / "kept.db"
    arguments = ("replay", "tests/data/drift-600s.blf", "--store", str(store), "--json", "--speed", "20")
    with sprung(*arguments, env=os.environ | {"OMP_NUM_THREADS": "1"}) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=180)
    assert json.loads(first)["outcome"] == "used"
    assert process.returncode == 130
    kept, interrupted = errors.splitlines()
    assert "windows are kept in" in kept and interrupted == "sprung: interrupted"
    import sqlite3

    with sqlite3.connect(store) as connection:
        assert connection.execute("SELECT count(*) FROM windows").fetchone()[0] >= 1
    connection.close()


def test_train_takes_several_recordings_and_tells_how_far_it_is(
    healthy: Path, csv_system: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}

    def train(system: System, out: Path, *, recordings: Any, settings: Any, progress: Any) -> Estimator:
        progress("simulate", 1, 2, float("nan"))
        asked.update(windows=recordings.shape, records=settings.records, out=out)
        return Estimator(system, new_estimator(system))

    monkeypatch.setattr("sprung.model.identification.amortised.training.train", train)
    arguments = ["train", "--system", str(csv_system), "--out", str(tmp_path), "--records", "5"]
    assert main([*arguments, "--recordings", str(healthy), str(healthy)]) == 0
    assert asked == {"windows": (2 * 79, 100, 28), "records": 5, "out": tmp_path}
    captured = capsys.readouterr()
    assert captured.err.startswith("training is optional: ")
    assert "\nsimulate: 1 of 2\n" in captured.err
    assert f"--system {csv_system} --weights {tmp_path}" in captured.err
    told = json.loads(captured.out)
    assert told["out"] == str(tmp_path)
    assert all(cost > 0 for pair in told["saved"].values() for cost in pair)


def test_system_shows_what_the_sensors_identify(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["system", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["parameters"]) == 24 and all(p["identifiable"] for p in told["parameters"])
    assert told["modes"][0]["frequency"] == pytest.approx(0.81, abs=0.01)
