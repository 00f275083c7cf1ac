"""`sprung bench replay`: recording to stored drift, times real time, and peak memory at two lengths.

Each run is a fresh process that imports, reads, identifies, tracks and stores into an empty SQLite file, as
`sprung replay FILE --store URL` does.  Memory is compared between the recording and the same vehicle ten times as
long: the recording played again and again with its time moved on.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.settings import Settings
from sprung.service.sources import feed, reading
from sprung.service.store import open_store

RECORDING = Path(__file__).resolve().parents[1] / "tests" / "data" / "drift-600s.blf"
TARGET = 100.0  # times real time

CHILD = """
import json, resource, sys, time
begun = time.perf_counter()
from pathlib import Path
from sprung.benchmarks.replay import one_run
print(json.dumps(one_run(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), begun)))
"""


def run(recording: Path = RECORDING, *, repeats: int = 3, lengths: str = "1,10") -> Iterator[dict[str, Any]]:
    """Figures; `lengths`: how often the recording is played for the memory figures."""
    runs = [_child(recording, 1) for _ in range(repeats)]
    best = min(runs, key=lambda r: r["seconds"])
    recorded = best["recorded_seconds"]
    yield {
        "figure": "times real time, replay",
        "value": round(recorded / best["seconds"], 1),
        "unit": "x",
        "target": f">= {TARGET:g}",
        "runs": [round(recorded / r["seconds"], 1) for r in runs],
        "note": "file to stored drift, without interpreter start and imports",
    }
    yield {
        "figure": "times real time, whole process",
        "value": round(recorded / best["process_seconds"], 1),
        "unit": "x",
        "windows": best["windows"],
        "cores": os.cpu_count(),
        "note": "with interpreter start and imports",
    }
    yield {"figure": "seconds by stage", "value": best["stages"], "unit": "s", "note": "stages overlap"}
    peaks = {}
    for times in (int(text) for text in lengths.split(",")):
        measured = _child(recording, times)
        peaks[times] = measured["peak_bytes"]
        yield {
            "figure": "peak memory",
            "value": round(measured["peak_bytes"] / 1e6),
            "unit": "MB",
            "recorded_seconds": round(measured["recorded_seconds"]),
        }
    shortest, longest = peaks[min(peaks)], peaks[max(peaks)]
    yield {
        "figure": "peak memory, longest over shortest",
        "value": round(longest / shortest, 3),
        "unit": "1",
        "target": "about 1: flat in file length",
    }


def one_run(recording: Path, store_file: str, times: int, begun: float) -> dict[str, Any]:
    """In the child: replay into a store, `times` after one another, and measure."""
    engine = load_engine(Settings())
    stages: dict[str, float] = {}

    def add(batch: Batch) -> None:
        for stage, seconds in batch.seconds.items():
            stages[stage] = stages.get(stage, 0.0) + seconds

    if times > 1:
        reading.open_recording = _longer(reading.open_recording, times)  # type: ignore[attr-defined]  # the child's own
    started = time.perf_counter()
    store, compute = open_store(store_file), Compute(8)
    fed = feed.feed_file(Pipeline(engine, store, compute), recording, on_batch=add)
    compute.close()
    store.close()
    ended = time.perf_counter()
    return {
        "seconds": ended - started,
        "process_seconds": ended - begun,
        "recorded_seconds": fed.recorded_seconds,
        "windows": sum(fed.windows.values()),
        "stages": {stage: round(seconds, 2) for stage, seconds in stages.items()},
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def _longer(open_recording: Any, times: int) -> Any:
    """`open_recording` whose recordings go on: the file again and again, its time moved on by its length."""

    def opened(*arguments: Any, **options: Any) -> Any:
        recording = open_recording(*arguments, **options)
        play = recording.blocks

        def blocks() -> Iterator[Any]:
            first = last = None
            shift = 0
            for turn in range(times):
                source = play() if turn == 0 else open_recording(*arguments, **options).blocks()
                for block in source:
                    first = int(block.time[0]) if first is None else first
                    last = int(block.time.max())
                    yield replace(block, time=block.time + shift)
                assert first is not None and last is not None
                shift += last - first + 10_000_000

        recording.blocks = blocks
        return recording

    return opened


def _child(recording: Path, times: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as folder:
        command = [sys.executable, "-c", CHILD, str(recording), f"{folder}/bench.db", str(times)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"{recording}: {done.stderr.strip().splitlines()[-1]}")
    measured: dict[str, Any] = json.loads(done.stdout)
    return measured
