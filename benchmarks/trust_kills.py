"""What is killed: each kind kills one process at a random moment, looks at once at what is left, and sums up."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
import sqlite3
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sprung.benchmarks.trust_ride import SYSTEM_FILE, RestlessRide
from sprung.benchmarks.trust_service import ServiceProcess, audit, clients, settled
from sprung.benchmarks.trust_zygote import DONE, GO, Forked, Zygote
from sprung.service.times import to_iso

QUICK, SLOW, SOON = 2.0, 12.0, 8.0  # s after readiness in half of the kills, in most others; after the start in a fifth
CHAIN = 4  # kills of one replay before it may end
REPLAY_SECONDS, REPLAY_SPEED = 60.0, 20


class Kills(Protocol):
    """One kind."""

    def kill(self, rng: random.Random) -> dict[str, Any]:
        """Start, kill, look; what to note of it."""

    def outcome(self) -> dict[str, Any]:
        """What all kills of this kind came to; may start what was killed once more."""


class ServiceKills:
    """A service under windows, recordings and diagnoses, on one data folder from the first kill to the last."""

    def __init__(self, folder: Path, ride: RestlessRide, zygote: Zygote) -> None:
        self._folder = folder
        self._zygote = zygote
        self._ride = ride
        self._counts = LastingCounts(folder / "counts.json")

    def kill(self, rng: random.Random) -> dict[str, Any]:
        """Killed while it starts, or a while after it was ready."""
        senders = clients(self._folder / "ledgers", self._ride)
        for sender in senders:
            sender.start()
        kind = rng.random()
        with ServiceProcess(self._folder / "data", self._zygote) as served:
            if kind < 0.2:
                delay = rng.uniform(0.0, SOON)
            else:
                served.ready()
                delay = rng.uniform(0.02, QUICK if kind < 0.6 else SLOW)
                for sender in senders:
                    sender.port = served.port
            time.sleep(delay)
            orphans = served.kill()
        for sender in senders:
            sender.port = None
            sender.stop()
        self._counts.add(orphans=orphans, damaged=integrity(self._folder / "data" / "sprung.db") != "ok")
        return {"seconds": round(delay, 3), "ready": kind >= 0.2}

    def outcome(self) -> dict[str, Any]:
        """After one more start, and the end of every job."""
        senders = clients(self._folder / "ledgers", self._ride)
        with ServiceProcess(self._folder / "data", self._zygote) as served:
            served.ready()
            settled(served.port, senders)
            served.kill()
        return audit(self._folder / "data", self._folder / "ledgers", self._ride) | self._counts.counts


class ReplayKills:
    """`sprung replay --store`, killed up to four times, then let run to its end, and compared with one left alone."""

    def __init__(self, folder: Path, ride: RestlessRide, zygote: Zygote) -> None:
        self._folder = folder
        self._zygote = zygote
        folder.mkdir(parents=True, exist_ok=True)
        self._counts = LastingCounts(folder / "counts.json")
        self._ride = folder / "ride.csv"
        self._ride.write_bytes(ride.csv(0, REPLAY_SECONDS))

    def kill(self, rng: random.Random) -> dict[str, Any]:
        """In the chain that is open; the last kill of a chain closes it."""
        state = LastingCounts(self._folder / "chain.json")
        store, printed = self._folder / "chain.db", self._folder / "printed.jsonl"
        undisturbed = self._undisturbed()
        if not state.counts.get("kills"):
            for path in [printed, *self._folder.glob("chain.db*")]:
                path.unlink(missing_ok=True)
        delay = rng.uniform(0.3, 1.0) * undisturbed
        process = self._start(store, printed)
        time.sleep(delay)
        process.kill()
        self._counts.add(damaged=integrity(store) != "ok")
        state.add(kills=1)
        if state.counts["kills"] >= CHAIN:
            self._close(store, printed)
            state.clear()
        return {"seconds": round(delay, 3)}

    def outcome(self) -> dict[str, Any]:
        """Over all chains that were closed."""
        return self._counts.counts

    def _close(self, store: Path, printed: Path) -> None:
        self._start(store, printed).wait()
        reported = {line["window"] for line in map(_object, printed.read_text().splitlines()) if "window" in line}
        alone, mine = content(self._folder / "alone.db"), content(store)
        self._counts.add(
            chains=1,
            windows_printed=len(reported),
            windows_lost=len(reported - _starts(store)),
            windows_differ=len(set(alone["windows"]) ^ set(mine["windows"])),
            posterior_differs=alone["tracker"] != mine["tracker"],
            rollups_differ=alone["rollups"] != mine["rollups"],
        )

    def _undisturbed(self) -> float:
        """Seconds of a replay that nobody disturbs."""
        note = self._folder / "alone.json"
        if not note.exists():
            begun = time.monotonic()
            self._start(self._folder / "alone.db", self._folder / "alone.jsonl").wait()
            note.write_text(json.dumps({"seconds": time.monotonic() - begun}))
        return float(json.loads(note.read_text())["seconds"])

    def _start(self, store: Path, out: Path) -> Forked:
        more = ["--store", str(store), "--json", "--speed", str(REPLAY_SPEED), "--vehicle", "a"]
        return self._zygote.command("replay", str(self._ride), "--system", str(SYSTEM_FILE), *more, out=out)


@dataclass(frozen=True, slots=True)
class KilledStep:
    """A short step of a command: migration, retention, back-up, restoration."""

    code: str  # Python that works in its current folder, after `go()`
    prepare: Callable[[Path], None]  # makes that folder
    judge: Callable[[Path, bool], dict[str, int]]  # the folder, and whether the step was done again: what is wrong


class StepKills:
    """A step in a process that says when it begins."""

    def __init__(self, folder: Path, zygote: Zygote, step: KilledStep) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._counts = LastingCounts(folder / "counts.json")
        self._zygote = zygote
        self._step = step

    def kill(self, rng: random.Random) -> dict[str, Any]:
        """After up to 1.2 times what the step takes alone; what ended before is killed in vain, and counted so."""
        alone = self._alone()
        place = fresh(self._folder / "place", self._step.prepare)
        process, delay = started(self._step, place, self._zygote), rng.uniform(0.0, 1.2) * alone
        time.sleep(delay)
        missed = not process.alive
        process.kill()
        first = self._step.judge(place, False)
        again = started(self._step, place, self._zygote)
        again.wait()
        self._counts.add(too_late=missed, **first, failed_afterwards=not (place / DONE).exists())
        self._counts.add(**{f"{name}_afterwards": value for name, value in self._step.judge(place, True).items()})
        shutil.rmtree(place)
        return {"seconds": round(delay, 4), "too_late": missed}

    def outcome(self) -> dict[str, Any]:
        """Over all kills."""
        return self._counts.counts

    def _alone(self) -> float:
        note = self._folder / "alone.json"
        if not note.exists():
            place = fresh(self._folder / "place", self._step.prepare)
            process = started(self._step, place, self._zygote)
            begun = time.monotonic()
            process.wait()
            if not (place / DONE).exists():
                raise ValueError(f"the step fails when nobody kills it: {self._step.code[-200:]}")
            note.write_text(json.dumps({"seconds": time.monotonic() - begun}))
        return float(json.loads(note.read_text())["seconds"])


def fresh(place: Path, prepare: Callable[[Path], None]) -> Path:
    """A folder that holds what was prepared, and nothing else."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    prepare(place)
    return place


def started(step: KilledStep, place: Path, zygote: Zygote) -> Forked:
    """The process of a step, once it has begun."""
    for name in (GO, DONE):
        (place / name).unlink(missing_ok=True)
    process = zygote.step(step.code, place)
    while process.alive and not (place / GO).exists():
        time.sleep(0.0005)
    return process


class LastingCounts:
    """Counts that last."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.counts: Counter[str] = Counter(json.loads(path.read_text()) if path.exists() else {})

    def add(self, **more: float) -> None:
        """Add to the counts of these names."""
        for name, value in more.items():
            self.counts[name] += int(value)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text(json.dumps(self.counts))

    def clear(self) -> None:
        """Begin anew."""
        self.counts.clear()
        self._path.unlink(missing_ok=True)


def rows(path: Path, query: str) -> list[Any]:
    if not path.exists():
        return []
    with contextlib.closing(sqlite3.connect(path, timeout=30)) as store:
        return store.execute(query).fetchall()


def integrity(path: Path) -> str:
    return str(rows(path, "PRAGMA integrity_check")[0][0]) if path.exists() else "ok"


def count(path: Path, table: str) -> int:
    try:
        return int(rows(path, f"SELECT count(*) FROM {table}")[0][0])
    except (sqlite3.OperationalError, IndexError):
        return -1  # no such table


def content(path: Path) -> dict[str, Any]:
    """What a replay leaves in a store, for comparison."""
    return {
        "windows": rows(path, "SELECT start_ns, outcome, log_ratio, std FROM windows"),
        "tracker": rows(path, "SELECT vehicle_id, state FROM tracker_states"),
        "rollups": rows(path, "SELECT resolution_s, bucket_ns, windows, mean, std FROM rollups ORDER BY 1, 2"),
    }


def _starts(path: Path) -> set[str]:
    return {to_iso(row[0]) for row in rows(path, "SELECT start_ns FROM windows")}


def _object(line: str) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError:  # the kill cut it
        return {}
    return found if isinstance(found, dict) else {}
