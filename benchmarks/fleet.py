"""`sprung bench fleet PART`: the same on one process and on many, and what many cost.

PART is one of identity, scaling, ingest, start, edge, chaos, cluster, plan, or quick (identity, edge, cluster and
plan).  Ray and PostgreSQL are used where they are installed; a part that needs one that is not says so and ends.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.fleet_chaos import chaos
from sprung.benchmarks.fleet_compare import differences
from sprung.benchmarks.fleet_load import ingest
from sprung.benchmarks.fleet_plan import cluster, measured_stages, plan
from sprung.benchmarks.fleet_processes import busy_seconds
from sprung.benchmarks.fleet_start import start
from sprung.model.identification.excitation import simulate_runs
from sprung.model.system import System, load_system
from sprung.replay.writing import write_recording
from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.fleet.backfill import BackfillPlan, FoldedFile, backfill, engine_of, opened_store
from sprung.service.fleet.onboard import Onboard, OnboardSettings
from sprung.service.fleet.recordings import list_recordings
from sprung.service.fleet.spool import Spool
from sprung.service.fleet.tasks import HereTasks, RayTasks, Tasks
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.sources.feed import feed_file
from sprung.service.sources.reading import ReadRequest, ThreadReading

Figures = Iterator[dict[str, Any]]
FIRST = 1_790_000_000_000_000_000  # ns
PARTS = ("identity", "scaling", "ingest", "start", "edge", "chaos", "cluster", "plan", "quick")
TOLERANCE = 1e-12


def run(
    part: str = "quick",
    *,
    recordings: int = 10,
    seconds: float = 30.0,
    workers: int = 2,
    minutes: float = 2.0,
    every: float = 30.0,
    vehicles: int = 10_000,
    together: int | None = None,
) -> Figures:
    """Figures of one part.

    recordings, seconds: of identity and scaling; workers: Ray's cores; minutes: of chaos, and of many vehicles in
    ingest (0: none); every: s between kills; together: windows in a request of ingest, by default one, then ten.
    """
    if part not in PARTS:
        raise UserError(f"bench fleet: no part {part!r}; known are {', '.join(PARTS)}")
    if part in ("identity", "quick"):
        yield from identity(recordings, seconds, workers)
    if part == "scaling":
        yield from scaling(recordings, seconds, workers)
    if part == "ingest":
        yield from ingest(workers, seconds, minutes, *([(together,)] if together else []))
    if part == "start":
        yield from start(workers)
    if part in ("edge", "quick"):
        yield from edge(min(seconds, 120.0))
    if part == "chaos":
        yield from chaos(minutes, every)
    if part in ("cluster", "plan", "quick"):
        stages = measured_stages()
        yield from stages.figures()
        if part != "plan":
            yield from cluster(stages)
        if part != "cluster":
            yield from plan(stages, vehicles)


def make_recordings(folder: Path, system: System, count: int, seconds: float) -> None:
    """Recordings of count / 5 vehicles, five each in a row; in the third one of each a damper loses a third."""
    rng = np.random.default_rng(20_260_921)
    names = [p.name for p in system.tracked]
    damper = next(i for i, name in enumerate(names) if name.endswith(".damping"))
    for number in range(count):
        vehicle, part = divmod(number, 5)
        level = 0.05 * np.random.default_rng(vehicle).normal(size=(1, len(system.parameters)))
        level[0, damper] += np.log(2 / 3) * (part >= 2)
        values = simulate_runs(system, level, round(seconds * system.sample_rate), rng).values[0]
        start = FIRST + part * (round(seconds) + 5) * 10**9
        name = f"bench-{vehicle:04d}"
        write_recording(
            folder / f"{number:03d}-{name}.mcap", system.channels, values, system.sample_rate, start, vehicle=name
        )


def identity(count: int, seconds: float, workers: int) -> Figures:
    """One process and SQLite, replayed in order; against Ray and PostgreSQL, where they are installed, back-filled."""
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as text:
        folder = Path(text)
        place = folder / "recordings"
        place.mkdir()
        make_recordings(place, load_system(), count, seconds)
        plain = Settings(data_dir=folder / "plain")
        started = time.perf_counter()
        replay_in_order(plain, place)
        alone = time.perf_counter() - started
        with tasks(workers) as (doer, url):
            many = Settings(data_dir=folder / "many", store=url)
            started = time.perf_counter()
            summary = backfill(BackfillPlan(many, str(place), 0, 2**62), doer, workers, _silent)
            together = time.perf_counter() - started
            with opened_store(plain) as one, opened_store(many) as other:
                found = differences(one, other, engine_of(plain).digest, summary.vehicles)
            name = f"{doer.name}, {'PostgreSQL' if url else 'SQLite'}"
    yield {"figure": "recordings", "value": count, "seconds_each": seconds, "windows": summary.windows, "on": name}
    yield {"figure": "windows that differ", "value": found["windows"], "target": 0}
    yield {"figure": "alarms that differ", "value": found["alarms"], "of": found["alarms_of"], "target": 0}
    yield {"figure": "largest difference of posteriors", "value": found["posteriors"], "target": TOLERANCE}
    yield {"figure": "tracker states that differ", "value": found["states"], "target": 0}
    yield {"figure": "seconds, one process", "value": round(alone, 1), "on": "this machine as it is"}
    yield {"figure": f"seconds, {name}", "value": round(together, 1), "on": "this machine as it is"}


def replay_in_order(settings: Settings, place: Path) -> None:
    """What a single process does."""
    engine = engine_of(settings)
    with opened_store(settings) as store:
        compute = Compute(4)
        pipeline = Pipeline(engine, store, compute)
        for file in list_recordings(str(place)):
            feed_file(pipeline, Path(file.path))
        compute.close()


def scaling(count: int, seconds: float, workers: int) -> Figures:
    """The same back-fill in a plain loop, on 1 and on `workers` cores of Ray, each once warm.

    Walls are those of the machine as it is; processor time says what Ray and more workers cost, whatever else runs.
    """
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as text:
        place = Path(text) / "recordings"
        place.mkdir()
        make_recordings(place, load_system(), count, seconds)
        walls: dict[int, float] = {}
        busy: dict[int, float] = {}
        for number in (0, 1, workers):
            with tasks(number) as (doer, url):
                settings = Settings(data_dir=Path(text) / str(number), store=url)
                head = BackfillPlan(settings, str(place), 0, FIRST + 5 * 10**9)
                backfill(head, doer, max(number, 1), _silent)  # loads engines
                started, before = time.perf_counter(), busy_seconds()
                summary = backfill(BackfillPlan(settings, str(place), 0, 2**62), doer, max(number, 1), _silent)
                walls[number] = time.perf_counter() - started
                busy[number] = busy_seconds() - before
                yield {
                    "figure": f"windows per second, {doer.name}",
                    "value": round(summary.windows / walls[number], 1),
                    "windows": summary.windows,
                    "processor_milliseconds_a_window": round(1e3 * busy[number] / summary.windows, 2),
                    "load": os.getloadavg()[0],
                }
        for name, one, target in (("1 worker", 1, 0.9), ("a plain loop on each core", 0, 0.85)):
            yield {
                "figure": f"efficiency of {workers} workers against {name}",
                "value": round(walls[one] / (workers * walls[workers]), 3),
                "by_processor_time": round(busy[one] / busy[workers], 3),
                "target": target,
            }


def edge(seconds: float) -> Figures:
    """The bundled recording through what runs on board: bytes and processor time a second of the ride."""
    settings = Settings()
    engine = engine_of(settings)
    source = Path(__file__).resolve().parent.parent / "tests" / "data" / "drift-600s.blf"
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as text:
        spool = Spool(Path(text) / "edge.db", 10**9)
        onboard = Onboard(engine, "bench-0001", spool, OnboardSettings())
        hop = engine.system.hop / engine.system.sample_rate
        per = round(20 / hop)  # windows that are read before they are handed over
        begun = None
        for piece in ThreadReading(ReadRequest(source, engine.system, engine.dbc, per)).pieces(lambda: None):
            if begun is None and onboard.counts.windows:  # what is loaded and compiled once does not count
                begun = (time.process_time(), onboard.counts.windows)
            onboard.process("bench-0001", piece.windows)
            if onboard.counts.windows * hop >= seconds:
                break
        cpu = time.process_time() - (begun[0] if begun else 0.0)
        ridden = (onboard.counts.windows - (begun[1] if begun else 0)) * hop
        onboard.flush()
        whole = onboard.counts.windows * hop
        spool.close()
    counts = onboard.counts
    raw = 4 * len(engine.system.channels) * engine.system.sample_rate
    requests = counts.messages * 250  # header of a request on a kept connection
    yield {"figure": "raw samples, bytes per second as float32", "value": raw}
    yield {
        "figure": "estimates sent, bytes per second",
        "value": round((counts.message_bytes + requests) / whole, 1),
        "target": 500,
        "seconds": whole,
    }
    yield {"figure": "raw samples around alarms, bytes", "value": counts.raw_bytes, "files": counts.raw_files}
    yield {"figure": "share of a core on board", "value": round(cpu / ridden, 4), "target": 0.02, "reading": "included"}


class tasks:
    """Ray and PostgreSQL where there are, else what is there."""

    def __init__(self, workers: int) -> None:
        """workers: of Ray; 0: a plain loop."""
        self._workers = workers
        self._server: Any = None
        self._doer: Tasks | None = None

    def __enter__(self) -> tuple[Tasks, str | None]:
        url = None
        if not postgres.missing():
            self._server = postgres.server()
            url = self._server.__enter__().database()
        try:
            self._doer = RayTasks(self._workers) if self._workers else HereTasks()
        except UserError:
            self._doer = HereTasks()
        return self._doer, url

    def __exit__(self, *error: Any) -> None:
        if self._doer is not None:
            self._doer.close()
        if self._server is not None:
            self._server.__exit__(None, None, None)


def _silent(file: FoldedFile, done: int, of: int) -> None:
    """Nobody watches."""
