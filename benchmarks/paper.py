"""`sprung bench paper [TASK]`: every table row and figure of the paper, from nothing, beside the paper's values.

Tasks: the three visual systems, one of them with a wrong opening, methods with settings searched for each, the train
with constant, changing and drifting parameters, the kernels of Fig. 3, the experiments on phases and on features, and
what a window tells.  Checkpoints lie under `--out` (`runs/paper`, not kept in the repository): a command that was
stopped, or that ran out of `--minutes`, goes on where it was when it is given again.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast, get_args

import torch

from sprung.benchmarks import (
    drifting,
    paper_analysis,
    paper_settings,
    paper_sources,
    paper_train,
    paper_visual,
    phase_information,
    poor_opening,
    tuning,
    window_information,
)
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps.config import Budget
from sprung.model.alps.fit import OutOfTime
from sprung.service.errors import UserError

TASKS: dict[str, tuple[Callable[[PaperSettings], Iterator[dict[str, Any]]], tuple[str, ...]]] = {
    "systems": (paper_visual.system_rows, ()),
    "pendulum": (paper_visual.rows, paper_visual.METHODS),
    "mass_spring_damper": (paper_visual.rows, paper_visual.METHODS),
    "two_body": (paper_visual.rows, paper_visual.METHODS),
    "poor_opening": (poor_opening.rows, poor_opening.METHODS),
    "tuning": (tuning.rows, tuning.METHODS),
    "train": (paper_train.constant_rows, paper_train.CONSTANT_METHODS),
    "train_changing": (paper_train.changing_rows, paper_train.CHANGING_METHODS),
    "train_drifting": (drifting.rows, drifting.METHODS),
    "kernels": (paper_analysis.kernel_rows, ()),
    "phase": (paper_analysis.phase_rows, ()),
    "phase_information": (phase_information.rows, ()),
    "features": (paper_analysis.feature_rows, ()),
    "window_information": (window_information.rows, ()),
}


def run(
    task: str | None = None,
    *,
    method: str | None = None,
    budget: str = "quick",
    seeds: int = 1,
    seed: int = 0,
    out: Path | None = None,
    device: str = "cpu",
    minutes: float | None = None,
) -> Iterator[dict[str, Any]]:
    """One dict per row: task, method, figures, the paper's values, settings.

    task: one of `TASKS`, all by default; method: one of the task's or several between commas, "core": the paper's and
    the untrained ones;
    seeds: how many, from `seed` on, each with data, frames and networks of its own;
    out: folder of checkpoints and pictures; minutes: stop after this long, to be resumed by the same command.
    """
    _check(task, method, budget, device)
    if seeds < 1 or seed < 0:
        raise UserError(f"bench paper: --seeds {seeds} --seed {seed}: at least one seed, from 0 on")
    if minutes is not None and not minutes >= 0:
        raise UserError(f"bench paper: --minutes {minutes}: give 0 or more")
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())
    until = None if minutes is None else time.monotonic() + 60 * minutes
    for name in [task] if task else TASKS:
        rows, _ = TASKS[name]
        for at in range(seed, seed + seeds):
            settings = PaperSettings(name, method, cast(Budget, budget), at, out or Path("runs/paper"), device, until)
            settings.folder.mkdir(parents=True, exist_ok=True)
            try:
                for row in rows(settings):
                    row |= {"commit": commit(), "sources": paper_sources.sources(name), "arithmetic": arithmetic()}
                    _keep(settings, row)
                    yield row
            except OutOfTime as stop:
                yield {"task": name, "seed": at, "unfinished": str(stop)}
                return


@cache
def commit() -> str:
    """The commit that a row was made at, "+" after it where files differ; "unknown" outside a checkout."""
    root = Path(__file__).resolve().parent.parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=root, capture_output=True, text=True, check=True, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip()


def arithmetic() -> str:
    """What decides the last bits of a sum, and so where a training ends: vector instructions and torch's version."""
    return f"{torch.backends.cpu.get_cpu_capability()}, torch {torch.__version__}"


def _keep(settings: PaperSettings, row: dict[str, Any]) -> None:
    """Write a row beside the checkpoints, for `benchmarks.paper_report`."""
    folder = settings.out / settings.budget / "rows"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{paper_settings.row_name(row, settings.seed)}.json"
    path.write_text(json.dumps(row, indent=1) + "\n")


def _check(task: str | None, method: str | None, budget: str, device: str) -> None:
    if task is not None and task not in TASKS:
        raise UserError(f"bench paper: no task {task!r}; known are {', '.join(TASKS)}")
    if budget not in get_args(Budget):
        raise UserError(f"bench paper: no budget {budget!r}; known are {', '.join(get_args(Budget))}")
    if method is not None:
        known = TASKS[task][1] if task else tuple({m for _, methods in TASKS.values() for m in methods})
        if wrong := [name for name in method.split(",") if name not in (*known, paper_settings.CORE)]:
            raise UserError(f"bench paper: no method {wrong[0]!r}; known are {', '.join(known) or 'none'}")
    if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
        raise UserError(f"bench paper: no device {device!r} here; leave --device out for the CPU")
