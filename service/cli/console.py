"""What people see: progress on a terminal, plain lines in a pipe, the table of parameters."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from sprung.service.feed import OnBatch
from sprung.service.pages.render import percent, quantity
from sprung.service.processed import Batch
from sprung.service.views import VehicleView

PLAIN_SECONDS = 2.0  # between lines where there is no terminal
COLUMNS = {  # of the table of parameters, and the width from which they are shown
    "parameter": 0,
    "value": 64,
    "± std": 96,
    "nominal": 84,
    "ratio": 74,
    "drift": 0,
    "state": 0,
}
HEALTH_STYLE = {"ok": "green", "maintenance_required": "yellow"}


def errors() -> Console:
    """The console on stderr."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


class RecordingProgress:
    """Progress of one recording."""

    def __init__(self, name: str, seconds_per_window: float) -> None:
        self._name = name
        self._hop = seconds_per_window
        self._windows = 0
        self._started = time.monotonic()

    def on_batch(self, batch: Batch) -> str:
        """The line after a further batch."""
        self._windows += len(batch.records)
        recorded = self._windows * self._hop
        pace = recorded / max(time.monotonic() - self._started, 1e-6)
        return f"{self._name}: {self._windows} windows, {recorded:.0f} s recorded, {pace:.0f} x real time"


@contextmanager
def progress(name: str, hop_seconds: float, quiet: bool = False) -> Iterator[OnBatch]:
    """A callback for batches that shows how far a recording is: a bar on a terminal, else a line now and then."""
    console = errors()
    if quiet or not console.is_terminal:
        yield _silent if quiet else plain_progress(name, hop_seconds)
        return
    shown = RecordingProgress(name, hop_seconds)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(f"{name}: reading", total=None)
        yield lambda batch: bar.update(task, description=shown.on_batch(batch))


def plain_progress(name: str, hop_seconds: float) -> OnBatch:
    """A callback for batches that prints a line on stderr every few seconds."""
    shown = RecordingProgress(name, hop_seconds)
    last = time.monotonic()

    def on_batch(batch: Batch) -> None:
        nonlocal last
        line = shown.on_batch(batch)
        if time.monotonic() - last >= PLAIN_SECONDS:
            last = time.monotonic()
            print(line, file=sys.stderr, flush=True)

    return on_batch


def _silent(_batch: Batch) -> None:
    """Shows nothing."""


def width_of_output() -> int:
    """Columns of the terminal; of a pipe those that COLUMNS says, else enough for everything."""
    console = Console()
    if console.is_terminal:
        return console.width
    told = os.environ.get("COLUMNS", "")
    return int(told) if told.isdigit() and int(told) > 0 else 120


def parameter_table(view: VehicleView, width: int = 120) -> Table:
    """Every tracked parameter, the ones with alarms marked; on narrow terminals fewer columns, whole names."""
    style = HEALTH_STYLE.get(view.health, "red")
    table = Table(
        title=f"{view.vehicle}: [{style}]{view.health.replace('_', ' ')}[/{style}]",
        title_justify="left",
        title_style="bold",
    )
    shown = [name for name, least in COLUMNS.items() if width >= least]
    for name in shown:
        table.add_column(name, justify="left" if name in ("parameter", "state") else "right", no_wrap=True)
    for p in view.parameters:
        told = p.identifiable
        cells = {
            "parameter": p.name,
            "value": quantity(p.value, p.unit) if told else "–",
            "± std": quantity(p.std, p.unit) if told else "–",
            "nominal": quantity(p.nominal, p.unit),
            "ratio": f"{p.value / p.nominal:.3f}" if told else "–",
            "drift": percent(p.drift),
            "state": _state(p.alarm, told, p.drift),
        }
        colour = {"alarm": "red", "warning": "yellow"}.get(p.alarm or "")
        table.add_row(*(cells[name] for name in shown), style=colour)
    return table


def print_table(table: Table) -> None:
    """On stdout; in a pipe as wide as it needs to be, without colours."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=width_of_output(), no_color=True)
    console.print(table)


def _state(alarm: str | None, identifiable: bool, drift: float | None) -> str:
    if alarm is not None:
        return alarm
    if not identifiable:
        return "not identifiable"
    return "learning" if drift is None else "ok"


@contextmanager
def stages(console: Console) -> Iterator[Callable[[float, str], None]]:
    """A callback for the share that is done and what is done now: a bar on a terminal, else a line per stage."""
    if not console.is_terminal:
        shown = ""

        def plain(_share: float, stage: str) -> None:
            nonlocal shown
            if stage != shown:
                shown = stage
                print(stage, file=sys.stderr, flush=True)

        yield plain
        return
    with Progress(TextColumn("{task.description}"), BarColumn(), console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda share, stage: bar.update(task, completed=share, description=stage)


def silent_stage(_share: float, _stage: str) -> None:
    """Shows nothing."""
