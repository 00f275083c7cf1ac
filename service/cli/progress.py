"""How far a recording is: a bar on a terminal, plain lines in a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from sprung.model.text import counted
from sprung.service.cli.console import errors
from sprung.service.monitoring.processed import Batch
from sprung.service.sources.feed import OnBatch

PLAIN_SECONDS = 2.0  # between lines where there is no terminal


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
        return f"{self._name}: {counted(self._windows, 'window')}, {recorded:.0f} s recorded, {pace:.0f} x real time"


@contextmanager
def progress(name: str, hop_seconds: float, quiet: bool = False) -> Iterator[OnBatch]:
    """A callback for batches that shows how far a recording is: a bar on a terminal, else a line now and then."""
    console = errors()
    if quiet or not console.is_terminal:
        yield _silent if quiet else plain_progress(name, hop_seconds)
        return
    shown = RecordingProgress(name, hop_seconds)
    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
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
