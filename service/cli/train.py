"""`sprung train`."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sprung.model.identification.amortised.training import TrainingSettings, train, training_benefit
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, System, load_system
from sprung.service.can_database import database_of
from sprung.service.cli import apart
from sprung.service.cli.console import errors
from sprung.service.cli.targets import check_folder
from sprung.service.errors import UserError
from sprung.service.sources.reading import ReadRequest

OPTIONAL = (
    "training is optional: without weights every window is refined from the nominal values, to the same result; "
    "weights give it a nearer start"
)
WITH_LAWS = (
    "windows of a system with laws begin at the values of its file, not at those of weights: these weights are for the "
    "same vehicle without its laws"
)
TOGETHER = 128  # windows that the reader hands over at once


def run(system_file: Path | None, recordings: list[Path], dbc: Path | None, out: Path, changes: dict[str, Any]) -> int:
    """Train, and print the results."""
    check_folder(out)
    system = load_system(system_file or MANCHESTER)
    if not system.bodies:
        raise UserError(f"{system_file}: a component test has no bodies, so no estimator to train; use sprung diagnose")
    database = database_of(system, dbc)
    windows = whole_windows(system, recordings, database) if recordings else None
    given = {name: value for name, value in changes.items() if value is not None}
    settings = replace(TrainingSettings(), **given)
    print(OPTIONAL if not system.laws else WITH_LAWS, file=sys.stderr, flush=True)
    with TrainingProgress() as shown:
        estimator = train(system, out, recordings=windows, settings=settings, progress=shown.show)
    before, after = training_benefit(system, estimator)
    of_file = "" if system_file is None else f" --system {system_file}"
    use = f"use them with\n  sprung replay FILE{of_file} --weights {out}\n  sprung serve{of_file} --weights {out}"
    print(
        f"a window takes {after.iterations:.1f} instead of {before.iterations:.1f} iterations, "
        f"{after.milliseconds:.1f} instead of {before.milliseconds:.1f} ms of a core; "
        + ("without its laws" if system.laws else use),
        file=sys.stderr,
    )
    saved = {"iterations": [before.iterations, after.iterations], "ms": [before.milliseconds, after.milliseconds]}
    print(json.dumps({"out": str(out), "system": system.digest, "settings": given, "saved": saved}))
    return 0


def whole_windows(system: System, paths: list[Path], dbc: Path | None) -> FloatArray:
    """Windows of all recordings that were not dropped, read apart, shape (B, T, C)."""
    found = []
    for path in paths:
        for piece in apart.windows(ReadRequest(path, system, dbc, TOGETHER)):
            found += [w.values for w in piece.windows if w.outcome != "dropped"]
    if not found:
        raise UserError(f"{paths[0]}: no whole window to train from")
    return np.stack(found)


class TrainingProgress:
    """Progress by stage: bars on a terminal, else a line for every tenth of a stage."""

    def __init__(self) -> None:
        console = errors()
        self._bars: Progress | None = None
        if console.is_terminal:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
            self._bars = Progress(*columns, console=console)
        self._tasks: dict[str, TaskID] = {}
        self._tenth: tuple[str, int] = ("", -1)

    def __enter__(self) -> TrainingProgress:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def show(self, stage: str, done: int, total: int, loss: float) -> None:
        """Called by the training; `loss` is NaN in stages that have none."""
        shown = f", loss {loss:.4g}" if math.isfinite(loss) else ""
        if self._bars is not None:
            task = self._tasks.get(stage)
            if task is None:
                task = self._tasks[stage] = self._bars.add_task(stage, total=total)
            self._bars.update(task, completed=done, description=stage + shown)
            return
        tenth = (stage, 10 * done // max(total, 1))
        if tenth != self._tenth:
            self._tenth = tenth
            print(f"{stage}: {done} of {total}{shown}", file=sys.stderr, flush=True)
