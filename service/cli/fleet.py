"""`sprung fleet ...`."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from collections import Counter
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sprung.model.text import counted
from sprung.service.cli.options import time_of
from sprung.service.cli.targets import check_folder
from sprung.service.errors import UserError
from sprung.service.fleet.backfill import BackfillPlan, FoldedFile, backfill
from sprung.service.fleet.broker import Broker, ConsumerCounts, consume
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.kafka_broker import open_kafka
from sprung.service.fleet.many import diagnose_many
from sprung.service.fleet.nats_broker import NatsBroker, ack_seconds, without_password
from sprung.service.fleet.recordings import list_recordings
from sprung.service.fleet.tasks import tasks_for
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.observability.logs import set_up
from sprung.service.settings import settings_with
from sprung.service.store import open_store
from sprung.service.store.partitions import prepare
from sprung.service.times import NANOSECONDS, now_ns

FOREVER = 2**62


def run_backfill(
    options: dict[str, Any],
    place: str,
    since: str | None,
    until: str | None,
    on: str,
    workers: int | None,
    json_lines: bool,
) -> int:
    """Back-fill; 1 when a file could not be read whole."""
    plan = BackfillPlan(
        settings_with(options), _place(place), time_of("--since", since, 0), time_of("--until", until, FOREVER)
    )
    if plan.since >= plan.until:
        raise UserError(f"--until {until}: is not after --since {since}")
    list_recordings(plan.place)  # raises before anything is started
    started = time.perf_counter()

    def show(file: FoldedFile, done: int, of: int) -> None:
        if json_lines:
            summary = {"file": file.file.path, "vehicle": file.file.vehicle, "windows": file.windows}
            summary |= {"known": file.known, "problem": file.problem, "before": file.before}
            print(json.dumps(summary), flush=True)
        else:
            known = f", {file.known} known from another recording" if file.known else ""
            said = "done before" if file.before else file.problem or f"{counted(file.windows, 'window')}{known}"
            print(f"{done}/{of} {file.file.path} ({file.file.vehicle}): {said}", flush=True)

    tasks = tasks_for(_on(on), workers)
    try:
        summary = backfill(plan, tasks, workers or os.cpu_count() or 1, show)
    finally:
        tasks.close()
    seconds = time.perf_counter() - started
    if json_lines:
        print(
            json.dumps({"summary": asdict(summary) | {"wall_seconds": round(seconds, 1), "on": tasks.name}}), flush=True
        )
    else:
        for problem in summary.problems:
            print(f"sprung: {problem}", file=sys.stderr)
        print(
            f"{counted(summary.files, 'file')}, {summary.done_before} of them done before; "
            f"{counted(summary.windows, 'window')} of {counted(len(summary.vehicles), 'vehicle')} "
            f"in {seconds:.0f} s on {tasks.name}; {counted(len(summary.problems), 'problem')}"
        )
    return 1 if summary.problems else 0


def run_diagnose(options: dict[str, Any], place: str, out: Path, on: str, workers: int | None, json_lines: bool) -> int:
    """Diagnose many; 1 when one is not consistent, or cannot be diagnosed."""
    settings, started = settings_with(options), time.perf_counter()
    check_folder(out)
    list_recordings(_place(place))  # raises before anything is started
    tasks = tasks_for(_on(on), workers)
    verdicts: Counter[str] = Counter()
    before, problems = 0, []
    try:
        diagnosed = diagnose_many(settings, _place(place), out, tasks, workers or os.cpu_count() or 1)
        for done, (found, of) in enumerate(diagnosed, 1):
            verdicts[found.verdict or "not diagnosed"] += 1
            before += found.before
            problems += [f"{found.path}: {found.problem}"] if found.problem else []
            if json_lines:
                print(json.dumps(asdict(found)), flush=True)
            else:
                said = found.problem or "; ".join((found.verdict, *found.findings))
                print(f"{done}/{of} {found.path}: {said}{' (done before)' if found.before else ''}", flush=True)
    finally:
        tasks.close()
    seconds = time.perf_counter() - started
    if json_lines:
        summary = {"verdicts": verdicts, "done_before": before, "problems": problems, "wall_seconds": round(seconds, 1)}
        print(json.dumps({"summary": summary | {"on": tasks.name}}), flush=True)
    else:
        for problem in problems:
            print(f"sprung: {problem}", file=sys.stderr)
        by_verdict = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
        print(f"{by_verdict}; {before} of them done before; {seconds:.0f} s on {tasks.name}; reports in {out}")
    return 0 if set(verdicts) == {"consistent"} else 1


def run_consume(options: dict[str, Any], address: str, alive: Path | None) -> int:
    """Consume messages until stopped."""
    settings = settings_with(options)
    if alive is not None:
        alive.touch()  # raises now if it cannot be written
    set_up(settings.log_format, settings.log_level)
    engine = load_engine(settings)
    counts = ConsumerCounts()
    with ExitStack() as stack:
        store = open_store(settings.store_url)
        stack.callback(store.close)
        compute = Compute(1)
        stack.callback(compute.close)
        pipeline = Pipeline(engine, store, compute, vehicles_in_memory=settings.vehicles_in_memory)
        ingest = Ingest(pipeline, settings.late_seconds)
        ingest.start()
        stack.callback(ingest.close)
        asyncio.run(_consume(address, settings.late_seconds, ingest, counts, alive))
    print(
        f"{counted(counts.messages, 'message')} with {counted(counts.windows, 'window')} stored, "
        f"{counts.refused} refused",
        flush=True,
    )
    return 0


async def _consume(
    address: str, late_seconds: float, ingest: Ingest, counts: ConsumerCounts, alive: Path | None
) -> None:
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopping.set)
    broker = await _broker(address, late_seconds)
    print(f"sprung fleet: folding what {without_password(address)} holds; Ctrl-C stops", flush=True)
    try:
        await consume(broker, ingest, stopping, counts, (lambda: None) if alive is None else alive.touch)
    finally:
        await broker.close()


async def _broker(address: str, late_seconds: float) -> Broker:
    if address.startswith("nats://"):
        return await NatsBroker.open(address, ack_seconds(late_seconds))
    if address.startswith("kafka://"):
        return await open_kafka(address)
    raise UserError(f"{without_password(address)}: give nats://HOST:PORT or kafka://HOST:PORT/TOPIC")


def run_migrate(store: str | None) -> int:
    """Migrate and make partitions ahead."""
    settings = settings_with({"store": store})
    with closing(open_store(settings.store_url)) as opened:
        now = now_ns()
        prepare(opened, (now, now + 31 * 86_400 * NANOSECONDS))
        shown = opened.engine.url.render_as_string(hide_password=True)
    print(f"{shown}: tables are those of this version")
    return 0


def _place(text: str) -> str:
    return text if "://" in text else str(Path(text).absolute())


def _on(text: str) -> str:
    if text not in ("here", "ray", "auto"):
        raise UserError(f"--on {text}: known are here, ray, auto")
    return text
