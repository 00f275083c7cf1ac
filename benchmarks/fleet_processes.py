"""Processes that descend from one: which, and how much processor time they took.  Linux."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class RunningProcess:
    """One process as /proc tells of it."""

    pid: int
    parent: int
    seconds: float  # of processor time, with children that have ended
    command: str


def running() -> dict[int, RunningProcess]:
    """Every process, by its id."""
    found = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            fields = (place / "stat").read_text().rsplit(")", 1)[1].split()
            command = (place / "cmdline").read_text(errors="replace")
        except OSError:
            continue  # it has ended meanwhile
        seconds = sum(map(int, fields[11:15])) / TICKS
        found[int(place.name)] = RunningProcess(int(place.name), int(fields[1]), seconds, command)
    return found


def descendants(pid: int) -> list[RunningProcess]:
    """Those below a process, itself not among them."""
    known = running()

    def descends(one: RunningProcess) -> bool:
        seen = set()
        while one.parent in known and one.parent not in seen:
            if one.parent == pid:
                return True
            seen.add(one.parent)
            one = known[one.parent]
        return False

    return [one for one in known.values() if descends(one)]


def busy_seconds() -> float:
    """Processor time of this process and of all below it, so far, with those that have ended."""
    return sum(os.times()[:4]) + sum(one.seconds for one in descendants(os.getpid()))
