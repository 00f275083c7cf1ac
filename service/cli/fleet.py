"""`sprung fleet ...`."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sprung.service.errors import UserError
from sprung.service.fleet.backfill import BackfillPlan, FoldedFile, backfill
from sprung.service.fleet.many import diagnose_many
from sprung.service.fleet.tasks import tasks_for
from sprung.service.settings import settings_with
from sprung.service.times import from_iso

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
        settings_with(options), _place(place), _time("--since", since, 0), _time("--until", until, FOREVER)
    )
    started = time.perf_counter()

    def show(file: FoldedFile, done: int, of: int) -> None:
        if json_lines:
            told = {"file": file.file.path, "vehicle": file.file.vehicle, "windows": file.windows}
            print(json.dumps(told | {"problem": file.problem, "before": file.before}), flush=True)
        else:
            said = "done before" if file.before else file.problem or f"{file.windows} windows"
            print(f"{done}/{of} {file.file.path} ({file.file.vehicle}): {said}", flush=True)

    tasks = tasks_for(_on(on), workers)
    try:
        told = backfill(plan, tasks, workers or os.cpu_count() or 1, show)
    finally:
        tasks.close()
    seconds = time.perf_counter() - started
    if json_lines:
        print(json.dumps({"summary": asdict(told) | {"wall_seconds": round(seconds, 1), "on": tasks.name}}), flush=True)
    else:
        for problem in told.problems:
            print(f"sprung: {problem}", file=sys.stderr)
        print(
            f"{told.files} files, {told.done_before} of them done before; {told.windows} windows of "
            f"{len(told.vehicles)} vehicles in {seconds:.0f} s on {tasks.name}; {len(told.problems)} problems"
        )
    return 1 if told.problems else 0


def run_diagnose(options: dict[str, Any], place: str, out: Path, on: str, workers: int | None, json_lines: bool) -> int:
    """Diagnose many; 1 when one is not consistent, or cannot be diagnosed."""
    tasks = tasks_for(_on(on), workers)
    bad = 0
    try:
        for found in diagnose_many(settings_with(options), _place(place), out, tasks):
            bad += found.verdict != "consistent"
            if json_lines:
                print(json.dumps(asdict(found)), flush=True)
            elif found.problem:
                print(f"sprung: {found.path}: {found.problem}", file=sys.stderr)
            else:
                print(f"{found.path}: {found.verdict}{''.join(f'; {text}' for text in found.findings)}", flush=True)
    finally:
        tasks.close()
    return 1 if bad else 0


def _place(text: str) -> str:
    return text if "://" in text else str(Path(text).absolute())


def _on(text: str) -> str:
    if text not in ("here", "ray", "auto"):
        raise UserError(f"--on {text}: known are here, ray, auto")
    return text


def _time(option: str, text: str | None, default: int) -> int:
    try:
        return default if text is None else from_iso(text)
    except (ValueError, OverflowError):
        raise UserError(f"{option} {text}: give an RFC 3339 time, as in 2026-09-21T14:13:20Z") from None
