"""Power cuts: one traced run of the service under load, and what its disk may hold at many moments of it.

What was acknowledged (the answer was on its way to the client) before a moment must be in the store that is found after
a cut at that moment.
"""

from __future__ import annotations

import random
import re
import shutil
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_clients import UPLOAD_SECONDS
from sprung.benchmarks.trust_disk import TRACED, ForgetfulDisk, SystemCall, system_calls
from sprung.benchmarks.trust_ride import START_SECONDS, RestlessRide
from sprung.benchmarks.trust_service import ServiceProcess, clients

RUN_SECONDS = 40.0
ACKNOWLEDGED = re.compile(rb"HTTP/1\.1 20[02] .*?x-request-id: (window|upload|diagnosis)-(\d+)\r\n", re.S | re.I)


def power_cuts(folder: Path, cuts: int, seed: int) -> Iterator[dict[str, Any]]:
    """Figures; a message where there is no strace, or where it may not trace."""
    if shutil.which("strace") is None:
        yield {"figure": "power cuts", "value": None, "skipped": "strace is not installed"}
        return
    ride = RestlessRide()
    log, data = folder / "trace.log", folder / "data"
    if not log.exists():
        _record(folder, log, data, ride)
    with open(log, encoding="ascii", errors="replace") as lines:
        calls = list(system_calls(lines, str(data)))
    syncs = sum(call.name == "sync" for call in calls)
    if not syncs:
        yield {"figure": "power cuts", "value": None, "skipped": "strace saw no file synced"}
        return
    first = next((n for n, call in enumerate(calls) if call.name == "create"), 0)
    rng = random.Random(seed)
    moments = sorted(rng.sample(range(first, len(calls)), min(cuts, len(calls) - first)))
    wrong, acknowledged = _at(calls, moments, data, folder / "after", ride, rng)
    yield {"figure": "power cuts", "value": len(moments), "system calls": len(calls), "syncs": syncs}
    yield {"figure": "acknowledged before the last cut"} | acknowledged
    for name in ("windows_lost", "uploads_lost", "uploads_short", "reports_without_page", "store_unreadable"):
        yield {"figure": name.replace("_", " "), "value": wrong[name], "target": "0"}


def _record(folder: Path, log: Path, data: Path, ride: RestlessRide) -> None:
    """Run the service under strace for a while."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    part = log.with_suffix(".part")
    trace = ("strace", "-f", "-y", "-xx", "-s", "10000000", "--seccomp-bpf", "-e", f"trace={TRACED}", "-o", str(part))
    senders = clients(folder / "ledgers", ride)
    with ServiceProcess(data, before=trace) as served:
        served.ready()
        for sender in senders:
            sender.port = served.port
            sender.start()
        time.sleep(RUN_SECONDS)
        for sender in senders:
            sender.stop()
        served.kill()
    part.rename(log)


def _at(
    calls: list[SystemCall], moments: list[int], data: Path, after: Path, ride: RestlessRide, rng: random.Random
) -> tuple[Counter[str], dict[str, int]]:
    """What is wrong after a cut at each moment; what was acknowledged at the last."""
    disk = ForgetfulDisk(str(data))
    reported: dict[str, set[int]] = {"window": set(), "upload": set(), "diagnosis": set()}
    wrong: Counter[str] = Counter()
    waiting = iter([*moments, -1])
    moment = next(waiting)
    for number, call in enumerate(calls):
        if number == moment:
            shutil.rmtree(after, ignore_errors=True)
            after.mkdir(parents=True)
            disk.write(disk.after_a_cut(rng), after)
            wrong.update(_wrong(after, reported, ride))
            moment = next(waiting)
        if call.name == "send":
            for kind, which in ACKNOWLEDGED.findall(call.data):
                reported[kind.decode()].add(int(which))
        else:
            disk.take(call)
    shutil.rmtree(after, ignore_errors=True)
    return wrong, {kind: len(numbers) for kind, numbers in reported.items()}


def _wrong(after: Path, reported: dict[str, set[int]], ride: RestlessRide) -> dict[str, int]:
    store = after / "sprung.db"
    if not store.exists():
        return {
            "windows_lost": len(reported["window"]),
            "uploads_lost": len(reported["upload"]) + len(reported["diagnosis"]),
        }
    try:
        with closing(sqlite3.connect(store)) as opened:
            if opened.execute("PRAGMA integrity_check").fetchone()[0] != "ok":
                return {"store_unreadable": 1}
            tables = {row[0] for row in opened.execute("SELECT name FROM sqlite_master")}
            if "jobs" not in tables or "windows" not in tables:
                lost = len(reported["window"]) + len(reported["upload"])
                return {"windows_lost": lost} if lost else {}
            starts = {row[0] for row in opened.execute("SELECT start_ns FROM windows WHERE vehicle_id = 'windows'")}
            files = dict(
                opened.execute(
                    "SELECT j.vehicle_id, r.file FROM jobs j JOIN recordings r ON r.id = j.recording_id"
                ).fetchall()
            )
            reports = [row[0] for row in opened.execute("SELECT id FROM reports")]
    except sqlite3.DatabaseError:
        return {"store_unreadable": 1}
    hop = ride.system.hop / ride.system.sample_rate
    missing = sum(round((START_SECONDS + number * hop) * 1e9) not in starts for number in reported["window"])
    sent = [(f"{kind}-{number}", number) for kind in ("upload", "diagnosis") for number in reported[kind]]
    short = 0
    for vehicle, number in sent:
        if files.get(vehicle):
            path = after / "uploads" / files[vehicle]
            short += not path.exists() or path.read_bytes() != ride.csv(number, UPLOAD_SECONDS)
    pages = [after / "reports" / report / "report.html" for report in reports]
    return {
        "windows_lost": missing,
        "uploads_lost": sum(vehicle not in files for vehicle, _ in sent),
        "uploads_short": short,
        "reports_without_page": sum(not page.exists() or not page.read_bytes() for page in pages),
    }
