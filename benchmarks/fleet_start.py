"""What a start of `sprung fleet serve` takes: by the clock, and of processor time, by process."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

from sprung.benchmarks.fleet_load import served
from sprung.benchmarks.fleet_processes import RunningProcess, descendants

REPLICA = re.compile(r"ray::ServeReplica:sprung:(\w+)")


def start(workers: int) -> Iterator[dict[str, Any]]:
    """Figures of one start on `workers` cores with SQLite, up to the first answer that it is ready."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        began = time.monotonic()
        served(stack, ["fleet", "serve", "--workers", str(workers), "--port"], folder, {}, "/health/ready")
        wall = time.monotonic() - began
        spent: dict[str, float] = defaultdict(float)
        for one in descendants(os.getpid()):
            spent[_part(one)] += one.seconds
    yield {"figure": "until ready", "value": round(wall, 1), "unit": "s", "target": 10.0, "load": os.getloadavg()[0]}
    yield {"figure": "processor time of all", "value": round(sum(spent.values()), 1), "unit": "s"}
    for name, seconds in sorted(spent.items(), key=lambda each: -each[1]):
        yield {"figure": f"processor time of {name}", "value": round(seconds, 1), "unit": "s"}


def _part(one: RunningProcess) -> str:
    if replica := REPLICA.match(one.command):
        return f"replica {replica[1]}"
    if one.command.startswith("ray::Serve"):
        return "Ray Serve's controller"
    return "the command" if "\0fleet\0serve\0" in one.command else "Ray's own processes"
