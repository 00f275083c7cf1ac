"""A real `sprung serve`, to be killed, and what is looked at afterwards."""

from __future__ import annotations

import http.client
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from sprung.benchmarks.trust_clients import UPLOAD_SECONDS, Files, Ledger, RestlessClient, Windows
from sprung.benchmarks.trust_ride import SYSTEM_FILE, RestlessRide
from sprung.benchmarks.trust_zygote import Forked, Zygote, alive, end_with_parent

READY_SECONDS = 240.0
SETTLE_SECONDS = 600.0


class ServiceProcess:
    """A `sprung serve` in a process of its own."""

    def __init__(
        self, folder: Path, zygote: Zygote | None = None, *, before: tuple[str, ...] = (), system: Path = SYSTEM_FILE
    ) -> None:
        """zygote: forks it; else it is started, by `before` where that is given (as strace does)."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self._traced = bool(before)
        arguments = ["serve", "--port", str(self.port), "--data-dir", str(folder), "--system", str(system)]
        self._started: subprocess.Popen[bytes] | None = None
        if zygote is not None:
            self.process: Forked = zygote.command(*arguments)
            return
        self._started = subprocess.Popen(
            [*before, sys.executable, "-m", "sprung", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=end_with_parent,  # noqa: PLW1509 (one system call)
        )
        self.process = Forked(self._started.pid)

    def __enter__(self) -> ServiceProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def ready(self) -> float:
        """Seconds until it answers."""
        begun = time.monotonic()
        while time.monotonic() - begun < READY_SECONDS and self.process.alive:
            try:
                with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=5)) as connection:
                    connection.request("GET", "/health/ready")
                    if connection.getresponse().status == 200:
                        return time.monotonic() - begun
            except (OSError, http.client.HTTPException):
                time.sleep(0.1)
        raise ValueError("the service did not become ready")

    def kill(self) -> int:
        """SIGKILL; the number of its children that are still there ten seconds later."""
        made = children(self.process.pid)
        if self._traced and made:  # the service is the tracer's child, and would outlive it
            Forked(made[0]).kill()
            self.process.wait(30.0)
        self.process.kill()
        if self._started is not None:
            self._started.wait()  # it is gone; Python hears it, too
        deadline = time.monotonic() + 10
        while (left := [pid for pid in made if alive(pid)]) and time.monotonic() < deadline:
            time.sleep(0.05)
        return len(left)


def children(pid: int) -> list[int]:
    """Processes that a process has made."""
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            found += [int(word) for word in path.read_text().split()]
    return found


def clients(folder: Path, ride: RestlessRide) -> list[RestlessClient]:
    """Windows, recordings and diagnoses, with their ledgers in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        Windows(Ledger(folder / "windows.jsonl"), ride),
        Files(Ledger(folder / "recordings.jsonl"), ride, "/recordings", "upload"),
        Files(Ledger(folder / "diagnoses.jsonl"), ride, "/diagnose", "diagnosis"),
    ]


def settled(port: int, senders: list[RestlessClient]) -> None:
    """Wait until every acknowledged job has ended."""
    deadline = time.monotonic() + SETTLE_SECONDS
    for sender in senders[1:]:
        sender.port = port
        while sender.ledger.entries and time.monotonic() < deadline:
            _, job = sender.ask("GET", f"/jobs/{sender.ledger.entries[-1]['job']}")
            if job["state"] not in ("queued", "running"):
                break
            time.sleep(0.3)


def audit(data: Path, ledgers: Path, ride: RestlessRide) -> dict[str, Any]:
    """What became of everything that was acknowledged; the store must be at rest."""
    windows, uploads, diagnoses = (
        Ledger(ledgers / f"{name}.jsonl").entries for name in ("windows", "recordings", "diagnoses")
    )
    expected = 1 + round((UPLOAD_SECONDS * ride.system.sample_rate - ride.system.window) // ride.system.hop)
    with closing(sqlite3.connect(data / "sprung.db")) as store:
        stored = dict(store.execute("SELECT start_ns, count(*) FROM windows WHERE vehicle_id = 'windows' GROUP BY 1"))
        each = dict(store.execute("SELECT vehicle_id, count(*) FROM windows GROUP BY 1"))
        rolled = dict(store.execute("SELECT vehicle_id, sum(windows) FROM rollups WHERE resolution_s = 60 GROUP BY 1"))
        tracked = dict(store.execute("SELECT vehicle_id, count(*) FROM windows WHERE tracked GROUP BY 1"))
        jobs = {row[0]: row[1:] for row in store.execute("SELECT id, state, error FROM jobs")}
        reports = {row[0] for row in store.execute("SELECT id FROM reports")}
        check = store.execute("PRAGMA integrity_check").fetchone()[0]
    given_up = {name for name, (state, error) in jobs.items() if state == "failed" and "died" in (error or "")}
    done = [entry for entry in uploads if entry["job"] in jobs and entry["job"] not in given_up]
    pages = {path.parent.name for path in (data / "reports").glob("*/report.html") if path.stat().st_size}
    ended = [entry["job"] for entry in diagnoses if entry["job"] not in given_up]
    return {
        "windows_acknowledged": len(windows),
        "windows_lost": len({entry["start"] for entry in windows} - set(stored)),
        "windows_doubled": sum(count - 1 for count in stored.values())
        + sum(abs(rolled.get(name, 0) - count) for name, count in tracked.items()),
        "uploads_acknowledged": len(uploads),
        "uploads_lost": sum(entry["job"] not in jobs for entry in uploads)
        + sum(jobs[entry["job"]][0] != "done" or each.get(entry["vehicle"], 0) < expected for entry in done),
        "uploads_doubled": sum(each.get(entry["vehicle"], 0) > expected for entry in done),
        "diagnoses_acknowledged": len(diagnoses),
        "diagnoses_lost": sum(jobs.get(job, ("",))[0] != "done" or job not in reports & pages for job in ended),
        "jobs_given_up_after_two_deaths": len(given_up),
        "leftovers": sum(path.name.endswith(".part") for path in [*_list(data / "uploads"), *_list(data / "reports")]),
        "integrity": check,
    }


def _list(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []
