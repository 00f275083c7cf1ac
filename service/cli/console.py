"""What people see: the consoles, tables, the stages of long work."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

MOST_COLUMNS = 1000  # of a table in a pipe


def errors() -> Console:
    """The console on stderr."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def width_of_output() -> int:
    """Columns of the terminal; of a pipe those that COLUMNS says, else enough for all columns of a table."""
    console = Console()
    if console.is_terminal:
        return console.width
    return _columns_wanted() or 120


def _columns_wanted() -> int | None:
    columns = os.environ.get("COLUMNS", "")
    return int(columns) if columns.isdigit() and int(columns) > 0 else None


def print_table(table: Table) -> None:
    """On stdout; in a pipe as wide as it needs to be, without colours.  Names in brackets are no markup."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        wide = Console(highlight=False, markup=False, width=MOST_COLUMNS, no_color=True)
        needed = Measurement.get(wide, wide.options, table).maximum
        width = width_of_output() if _columns_wanted() else max(width_of_output(), needed)
        console = Console(highlight=False, markup=False, width=width, no_color=True)
    console.print(table)


@contextmanager
def stages(console: Console) -> Iterator[Callable[[float, str], None]]:
    """A progress callback (share, stage): a bar on a terminal, else a line per stage."""
    if not console.is_terminal:
        shown = ""

        def plain(_share: float, stage: str) -> None:
            nonlocal shown
            if stage != shown:
                shown = stage
                print(stage, file=sys.stderr, flush=True)

        yield plain
        return
    with Progress(TextColumn("{task.description}", markup=False), BarColumn(), console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda share, stage: bar.update(task, completed=share, description=stage)


def silent_stage(_share: float, _stage: str) -> None:
    """Shows nothing."""
