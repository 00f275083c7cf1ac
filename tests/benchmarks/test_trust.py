"""What `sprung bench trust` rests on: a disk that forgets what was not synced, and kills that are counted."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from sprung.benchmarks import trust
from sprung.benchmarks.trust_disk import TRACED, ForgetfulDisk, SystemCall, system_calls
from sprung.benchmarks.trust_kills import KilledStep, LastingCounts, StepKills
from sprung.benchmarks.trust_ride import RestlessRide
from sprung.benchmarks.trust_step_cuts import cut_step
from sprung.benchmarks.trust_steps import KILLS
from sprung.benchmarks.trust_zygote import Zygote

ROOT = "/d"


def after(*calls: SystemCall, tries: int = 60) -> set[tuple[tuple[str, bytes], ...]]:
    """Everything that a cut after these calls was seen to leave."""
    disk = ForgetfulDisk(ROOT)
    for call in calls:
        disk.take(call)
    return {tuple(sorted(disk.after_a_cut(random.Random(seed)).items())) for seed in range(tries)}


CREATE, WRITE, SYNC = (
    SystemCall("create", "/d/a"),
    SystemCall("write", "/d/a", 0, b"abc"),
    SystemCall("sync", "/d/a"),
)


def test_what_was_synced_lasts_and_what_was_not_may_be_gone() -> None:
    assert after(CREATE, WRITE, SYNC) == {(("/d/a", b"abc"),)}
    assert after(CREATE, WRITE) == {(), (("/d/a", b""),), (("/d/a", b"abc"),)}
    found = after(CREATE, WRITE, SYNC, SystemCall("write", "/d/a", 1, b"XY"))
    assert found == {(("/d/a", b"abc"),), (("/d/a", b"aXY"),)}


def test_a_renamed_file_may_have_its_new_name_without_its_content() -> None:
    rename = SystemCall("rename", "/d/a", other="/d/b")
    assert (("/d/b", b""),) in after(CREATE, WRITE, rename)
    assert after(CREATE, WRITE, SYNC, rename) == {(("/d/a", b"abc"),), (("/d/b", b"abc"),)}
    assert after(CREATE, WRITE, SYNC, rename, SystemCall("sync", "/d")) == {(("/d/b", b"abc"),)}


def test_a_write_may_be_torn_at_a_sector() -> None:
    blocks = SystemCall("write", "/d/a", 0, b"x" * 1024)
    assert (("/d/a", b"x" * 512),) in after(CREATE, SYNC, blocks, tries=300)


COMMITS = """
import sqlite3, sys
store = sqlite3.connect(sys.argv[1] + "/s.db", isolation_level=None)
store.execute("PRAGMA journal_mode=WAL")
store.execute("PRAGMA synchronous=" + sys.argv[2])
store.execute("CREATE TABLE t (n)")
for number in range(20):
    store.execute("INSERT INTO t VALUES (?)", (number,))
    open(sys.argv[1] + f"/told-{number}", "x").close()
"""


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
@pytest.mark.parametrize(("synchronous", "loses"), [("FULL", False), ("OFF", True)])
def test_commits_that_are_not_synced_are_seen_to_be_lost(tmp_path: Path, synchronous: str, loses: bool) -> None:
    log, data = tmp_path / "log", tmp_path / "data"
    data.mkdir()
    trace = ["strace", "-f", "-y", "-xx", "-s", "100000", "-e", f"trace={TRACED}", "-o", str(log)]
    done = subprocess.run(
        [*trace, sys.executable, "-c", COMMITS, str(data), synchronous], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"strace may not trace here: {done.stderr[-200:]!r}")
    disk, told, lost = ForgetfulDisk(str(data)), 0, 0
    with open(log, encoding="ascii") as lines:
        for number, call in enumerate(system_calls(lines, str(data))):
            if "told-" in call.path:  # stands for an acknowledgement; it is no part of the disk
                told += 1
                place = tmp_path / f"after-{number}"
                disk.write(disk.after_a_cut(random.Random(number)), place)
                lost += max(0, told - _count(place / "s.db"))
            else:
                disk.take(call)
    assert told == 20
    assert (lost > 0) is loses


def _count(path: Path) -> int:
    try:
        with closing(sqlite3.connect(path)) as store:
            return int(store.execute("SELECT count(*) FROM t").fetchone()[0])
    except sqlite3.DatabaseError:
        return 0


HALF = """
import time
go()
open("first", "x").close()
time.sleep(0.05)
open("second", "x").close()
"""


def test_a_step_that_a_kill_leaves_half_done_is_counted(tmp_path: Path) -> None:
    def judge(place: Path, _done: bool) -> dict[str, int]:
        return {"half": (place / "first").exists() and not (place / "second").exists()}

    zygote = Zygote(warm=False)
    try:
        step = StepKills(tmp_path, zygote, KilledStep(HALF, lambda _place: None, judge))
        for number in range(4):
            step.kill(random.Random(number))
    finally:
        zygote.close()
    counts = step.outcome()
    assert counts["half"] > 0 and counts["failed_afterwards"] > 0, counts  # it cannot be done again: "x"


RENAMED = """
import os
from pathlib import Path
go()
for number in range(8):
    with open(f"{{number}}.part", "w") as file:
        file.write(3000 * "x")
        file.flush()
        if {synced}:
            os.fsync(file.fileno())
    os.replace(Path.cwd() / f"{{number}}.part", Path.cwd() / f"{{number}}")
"""


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
@pytest.mark.parametrize("synced", [True, False])
def test_a_power_cut_under_a_step_shows_what_was_not_synced(tmp_path: Path, synced: bool) -> None:
    def judge(place: Path, _done: bool) -> dict[str, int]:
        whole = [place / str(number) for number in range(8)]
        return {"short": sum(path.exists() and path.stat().st_size != 3000 for path in whole)}

    step = KilledStep(RENAMED.format(synced=synced), lambda place: (place / "old").touch(), judge)
    zygote = Zygote(warm=False)
    try:
        told = cut_step(tmp_path, "renamed", step, 12, zygote, 1, warm=False)
    except ValueError as error:
        pytest.skip(f"strace may not trace here: {error}")
    finally:
        zygote.close()
    assert told["cuts"] == 12 and not told["failed_afterwards"] and not told["short_afterwards"]
    assert (told["short"] > 0) is not synced


def test_a_kill_that_came_too_late_is_none_and_a_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Late:
        def __init__(self, *_: object) -> None:
            pass

        def kill(self, rng: random.Random) -> dict[str, object]:
            return {"too_late": rng.random() < 0.5}

        def outcome(self) -> dict[str, object]:
            return {}

    class Nobody:
        def close(self) -> None:
            pass

    monkeypatch.setattr(trust, "KILLS", (("late", Late, 1),))
    monkeypatch.setattr(trust, "Zygote", Nobody)
    first, *_ = trust.run(3, scarce_seconds=0.0, folder=str(tmp_path))
    second, *_ = trust.run(8, scarce_seconds=0.0, folder=str(tmp_path))
    assert (first["value"], second["value"]) == (3, 8)
    lines = [json.loads(line) for line in (tmp_path / "kills.jsonl").read_text().splitlines()]
    assert [line["number"] for line in lines] == list(range(1, len(lines) + 1))
    assert second["too_late"] == len(lines) - 8 == sum(line["too_late"] for line in lines) > 0


def test_counts_go_on_where_they_were_left(tmp_path: Path) -> None:
    LastingCounts(tmp_path / "c.json").add(kills=2, lost=False)
    counts = LastingCounts(tmp_path / "c.json")
    counts.add(kills=1)
    assert counts.counts == {"kills": 3, "lost": 0}


def test_what_is_sent_is_a_ride_that_the_system_takes() -> None:
    ride = RestlessRide(seconds=4.0)
    window = ride.window(3, "a")
    assert set(window["channels"]) == {channel.name for channel in ride.system.channels}
    assert len(window["channels"]["body"]) == ride.system.window
    assert ride.csv(0, 2.0).count(b"\n") == 1 + 400
    assert {kind for kind, _, _ in KILLS} >= {"service", "replay", "migration", "retention", "back-up", "restoration"}
