"""What a fleet costs, from stage times measured here: a simulated cluster, and a plan on paper.

The cluster is simulated event by event: files of a back-fill, or windows of live vehicles, wait for workers; folds wait
for their vehicle's turn and for the database.  What the database does is measured as time of its own, so that where it
bends is where one server's cores are all busy.
"""

from __future__ import annotations

import heapq
import pickle
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json
from sqlalchemy import text

from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import Estimate, Window
from sprung.service.fleet import local_postgres as postgres
from sprung.service.fleet.backfill import engine_of
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import WindowsToFold
from sprung.service.settings import Settings
from sprung.service.store import open_store
from sprung.service.store.archive import Archive
from sprung.service.store.partitions import prepare

Figures = Iterator[dict[str, Any]]
WORKERS = (4, 8, 16, 32, 64)
DATABASE_CORES = 8
HEADROOM = 0.7  # of the cores, busy
WINDOWS_PER_SECOND = 2.0  # of a vehicle that runs
RUNNING_SHARE = 0.5  # of the day
KEPT_DAYS = 30.0
CORE_YEAR = 250.0  # EUR: a rented core, a year: assumed, as the two below
GIGABYTE_YEAR = 1.2  # EUR: replicated network disk
OBJECT_GIGABYTE_YEAR = 0.25  # EUR: object storage


@dataclass(frozen=True, slots=True)
class FleetStages:
    """Processor seconds a window, and bytes."""

    identify_alone: float
    identify_batched: float
    fold: float  # tracker and packing, on a worker
    database: float  # the server's own, one transaction of `together` windows, a window
    together: int
    fold_live: float  # as the two above, one window each of some vehicles in a transaction
    database_live: float
    window_bytes: float  # in the store, indices included
    rollup_bytes: float  # a vehicle and day
    parquet_bytes: float  # a window in the archive
    state_bytes: float  # a vehicle's tracker as it is stored
    memory_bytes: float  # and in memory
    store: str

    def figures(self) -> Figures:
        """As they were measured."""
        for name, value in (
            ("identify, one window", self.identify_alone),
            ("identify, batched over vehicles", self.identify_batched),
            ("fold", self.fold),
            ("database", self.database),
            ("fold, one each of many vehicles", self.fold_live),
            ("database, one each of many vehicles", self.database_live),
        ):
            yield {"figure": f"processor time a window, {name}", "value": round(1e3 * value, 3), "unit": "ms"}
        yield {"figure": "store, bytes a window", "value": round(self.window_bytes), "on": self.store}
        yield {"figure": "archive, bytes a window", "value": round(self.parquet_bytes)}
        yield {
            "figure": "tracker state, bytes",
            "value": round(self.state_bytes),
            "in_memory": round(self.memory_bytes),
        }


def measured_stages(vehicles: int = 12, seconds: float = 30.0) -> FleetStages:
    """Stage times of this machine, from windows of several vehicles, batched over them."""
    engine = engine_of(Settings())
    system = engine.system
    level = 0.05 * np.random.default_rng(1).normal(size=(vehicles, len(system.parameters)))
    values = simulate_runs(system, level, round(seconds * system.sample_rate), np.random.default_rng(2)).values
    starts = range(0, values.shape[1] - system.window + 1, system.hop)
    engine.identify(values[:4, : system.window], starts=[0, 1, 2, 3])  # what is compiled once
    begun = time.process_time()
    for start in list(starts)[:20]:
        engine.identify(values[:1, start : start + system.window], starts=[start])
    alone = (time.process_time() - begun) / 20
    estimates = []
    begun = time.process_time()
    for first in starts:
        at = 1_790_000_000_000_000_000 + round(first / system.sample_rate * 1e9)
        found, _ = engine.identify(values[:, first : first + system.window], starts=[at] * vehicles)
        estimates.append((at, found))
    batched = (time.process_time() - begun) / (vehicles * len(starts))
    return _stored(engine, estimates, vehicles, alone, batched)


def _stored(engine: Any, estimates: list[Any], vehicles: int, alone: float, batched: float) -> FleetStages:
    """Fold them, 20 windows of a vehicle in a transaction, then one each of all, and look at what the server took and
    how much it holds."""
    together, system = 20, engine.system
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as folder:
        missing = postgres.missing()
        server = None if missing else postgres.server()
        running = server.__enter__() if server is not None else None
        url = f"sqlite:///{folder}/x.db" if running is None else running.database()
        store, compute = open_store(url), Compute(1)
        pipeline = Pipeline(engine, store, compute)
        prepare(store, (at for at, _ in estimates))
        parts = [
            {f"plan-{v}": [(at, found[v]) for at, found in estimates[first : first + together]]}
            for v in range(vehicles)
            for first in range(0, len(estimates), together)
        ]
        fold, database = _fold(pipeline, parts, running)
        size = _window_bytes(store, vehicles * len(estimates))
        each = [{f"live-{v}": [(at, found[v])] for v in range(vehicles)} for at, found in estimates[:together]]
        fold_live, database_live = _fold(pipeline, each, running)
        parquet = _parquet_bytes(store, Path(folder))
        state = pipeline.state("plan-0")
        states = float(len(to_json(state.to_dict()))), float(len(pickle.dumps(state)))
        compute.close()
        store.close()
        if server is not None:
            server.__exit__(None, None, None)
    points = 1440 * RUNNING_SHARE + 24 * RUNNING_SHARE
    rollups = points * (4 * 8 * len(system.tracked) + 120)
    name = f"SQLite ({missing})" if missing else "PostgreSQL"
    times = (alone, batched, fold, database, together, fold_live, database_live)
    return FleetStages(*times, size, rollups, parquet, *states, name)


def _fold(pipeline: Pipeline, parts: list[dict[str, list[tuple[int, Estimate]]]], running: Any) -> tuple[float, float]:
    """Processor seconds a window, of this process and of the server: a part, of vehicles, is one transaction."""
    system = pipeline.engine.system
    empty = np.empty((0, len(system.channels)))
    before, begun = _server_seconds(running), time.process_time()
    for part in parts:
        with pipeline.store.write() as connection:
            held = pipeline.hold_all(connection, part)
            asked = [
                WindowsToFold(
                    v, [Window(at, system.sample_rate, empty) for at, _ in found], [e for _, e in found], held[v]
                )
                for v, found in part.items()
            ]
            done = pipeline.fold_all(connection, asked)
        for one in done:
            pipeline.settle(one)
    count = sum(len(found) for part in parts for found in part.values())
    database = (_server_seconds(running) - before) / count if running is not None else 0.0
    return (time.process_time() - begun) / count, database


def _server_seconds(running: Any) -> float:
    """Processor time of PostgreSQL's processes so far, those that ended among them."""
    if running is None:
        return 0.0
    total, pid = 0.0, running.pid()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(stat.parent.name) == pid:
            total += sum(map(int, fields[11:15]))  # own, and of children that ended
        elif int(fields[1]) == pid:
            total += sum(map(int, fields[11:13]))
    return total / 100.0


def _window_bytes(store: Any, count: int) -> float:
    with store.read() as connection:
        if not store.many_writers:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
            return float(pages * connection.exec_driver_sql("PRAGMA page_size").scalar_one()) / count
        query = "SELECT sum(pg_total_relation_size(inhrelid)) FROM pg_inherits WHERE inhparent = 'windows'::regclass"
        return float(connection.execute(text(query)).scalar_one()) / count


def _parquet_bytes(store: Any, folder: Path) -> float:
    try:
        archive = Archive(str(folder / "archive"))
    except ValueError:
        return 0.0
    with store.read() as connection:
        kept = archive.keep(connection, 1)
    return sum(path.stat().st_size for path in (folder / "archive").rglob("*.parquet")) / max(kept, 1)


def simulate_cluster(stages: FleetStages, workers: int, vehicles: int, batches: int) -> float:
    """Seconds until every vehicle's `batches` batches are folded, in order, by `workers` cores and one database.

    A batch is identified by any worker that is free; its fold waits for the fold before it and takes the same worker;
    its transaction waits for one of the database's cores.
    """
    n = stages.together
    identify, fold, database = n * stages.identify_batched, n * stages.fold, n * stages.database
    free = [0.0] * workers
    servers = [0.0] * DATABASE_CORES
    last = [0.0] * vehicles
    for _ in range(batches):
        for vehicle in range(vehicles):
            at = heapq.heappop(free)
            ready = max(at + identify, last[vehicle]) + fold
            server = heapq.heappop(servers)
            done = max(ready, server) + database
            heapq.heappush(servers, done)
            heapq.heappush(free, done)
            last[vehicle] = done
    return max(last)


def cluster(stages: FleetStages) -> Figures:
    """Efficiency of 4 to 64 workers on a back-fill of 640 vehicles, and where the database's cores are all busy."""
    vehicles, batches = 640, 20
    one = simulate_cluster(stages, 1, vehicles, batches)
    for workers in WORKERS:
        share = one / (workers * simulate_cluster(stages, workers, vehicles, batches))
        yield {"figure": f"efficiency of {workers} workers, simulated", "value": round(share, 3), "target": 0.9}
    if stages.database:
        busy = (stages.identify_batched + stages.fold + stages.database) / stages.database * DATABASE_CORES
        yield {
            "figure": "workers at which the database's cores are all busy",
            "value": round(busy),
            "database_cores": DATABASE_CORES,
        }


def plan(stages: FleetStages, vehicles: int) -> Figures:
    """Cores, memory, database and cost of a fleet, a vehicle and year."""
    peak = vehicles * WINDOWS_PER_SECOND  # all run at once
    named: dict[str, tuple[float, float]] = {}  # cores at the peak: workers, database
    named["raw windows, one in a request"] = (
        peak * (stages.identify_batched + stages.fold_live) / HEADROOM,
        peak * stages.database_live / HEADROOM,
    )
    named["identified on board"] = (peak * stages.fold / HEADROOM, peak * stages.database / HEADROOM)
    per_day = WINDOWS_PER_SECOND * 86_400 * RUNNING_SHARE
    store = vehicles * (KEPT_DAYS * per_day * stages.window_bytes + 730 * stages.rollup_bytes) / 1e9
    archive = vehicles * 365 * per_day * stages.parquet_bytes / 1e9
    memory = vehicles * stages.memory_bytes / 1e9
    yield {"figure": "vehicles", "value": vehicles, "windows_per_second": peak, "running_share": RUNNING_SHARE}
    yield {"figure": "database", "value": round(store / 1e3, 1), "unit": "TB", "kept_days": KEPT_DAYS}
    yield {"figure": "archive of a year", "value": round(archive / 1e3, 1), "unit": "TB"}
    for name, (workers, database) in named.items():
        replicas = max(1, round(workers))
        cost = (workers + database) * CORE_YEAR + store * GIGABYTE_YEAR + archive * OBJECT_GIGABYTE_YEAR
        yield {
            "figure": f"cores, {name}",
            "value": round(workers + database, 1),
            "workers": round(workers, 1),
            "database": round(database, 1),
            "memory_gigabytes": round(memory + 0.6 * replicas + 4 * database, 1),
            "eur_per_vehicle_and_year": round(cost / vehicles, 2),
        }
