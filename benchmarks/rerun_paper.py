"""`sprung bench paper-cells`: random figures of docs/paper.md made again from nothing, and held against what it states.

Only tables that say which seeds they were made from, below them or line by line, are drawn from.  A figure of one seed
must come out again to the four digits that are printed, on a processor with the vector instructions that it was made
with (the page says which); one of several seeds within three of its standard deviations, from the first seed.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks import paper
from sprung.service.errors import UserError

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "paper.md"
BLOCK = re.compile(r"<!-- (?:rows|explained|variants) (\w+) -->(.*?)<!-- end -->", re.DOTALL)
SEEDS = re.compile(r"seeds? ([\d, ]+)")
CELL = re.compile(r"(-?[\d.]+(?:e[-+]?\d+)?)(?: ± ([\d.]+(?:e[-+]?\d+)?))?")
DIGITS = 1e-3  # relative: what four printed digits leave open


@dataclass(frozen=True)
class StatedCell:
    """One figure of the document."""

    task: str
    method: str
    column: str
    mean: float
    spread: float | None  # standard deviation over seeds; None: of one seed
    seeds: tuple[int, ...]

    @property
    def allowed(self) -> float:
        """By how much another run of the first seed may be off."""
        if self.spread is None:
            return DIGITS * abs(self.mean)
        return 3 * self.spread * math.sqrt(1 + 1 / len(self.seeds)) + DIGITS * abs(self.mean)


def run(
    count: int = 3, *, seed: int | None = None, task: str | None = None, document: Path | None = None
) -> Iterator[dict[str, Any]]:
    """One dict per cell: stated, again, whether within.

    count: cells; seed: of the choice, new ones every time by default; task: only of one; document: another page.
    """
    place = document or DOCUMENT
    if count < 1 or (seed is not None and seed < 0):
        raise UserError(f"bench paper-cells: {count} cells, --seed {seed}: at least one cell, seeds from 0 on")
    try:
        cells = [cell for cell in stated(place.read_text()) if task in (None, cell.task)]
    except OSError as error:
        raise UserError(f"bench paper-cells: {place}: {error.strerror}") from error
    if not cells:
        raise UserError(
            f"bench paper-cells: {place}: no figures{f' of {task}' if task else ''} that say from which seeds they are"
        )
    chosen = np.random.default_rng(seed).permutation(len(cells))[:count]
    for cell in (cells[i] for i in chosen):
        again = _again(cell)
        within = again is not None and abs(again - cell.mean) <= cell.allowed
        yield {
            "task": cell.task, "method": cell.method, "column": cell.column, "stated": cell.mean,
            "spread": cell.spread, "seeds": list(cell.seeds), "again": again, "within": within,
            "arithmetic": paper.arithmetic(),
        }  # fmt: skip


def stated(text: str) -> list[StatedCell]:
    """Every figure of the tables of a page that name their seeds."""
    found = []
    for task, block in BLOCK.findall(text):
        table, _, remark = block.strip().partition("\n\n")
        made = SEEDS.search(remark)
        lines = [[part.strip() for part in line.strip("| ").split("|")] for line in table.splitlines()]
        for line in lines[2:]:
            cells = dict(zip(lines[0][1:], line[1:], strict=False))
            seeds = cells.pop("seeds", made.group(1) if made else "")
            numbers = tuple(int(part) for part in seeds.replace(",", " ").split())
            for column, cell in cells.items():
                if numbers and (match := CELL.match(cell)):
                    spread = None if match.group(2) is None else float(match.group(2))
                    found.append(StatedCell(task, line[0], column, float(match.group(1)), spread, numbers))
    return found


def _again(cell: StatedCell) -> float | None:
    """The figure of the first seed, from nothing."""
    method = cell.method.split()[0]
    with tempfile.TemporaryDirectory(prefix="sprung-paper-") as folder:
        known = paper.TASKS[cell.task][1]
        rows = paper.run(
            cell.task, method=method if method in known else None, seeds=1, seed=cell.seeds[0], out=Path(folder)
        )
        for row in rows:
            if (row.get("method") or f"{row.get('inputs')} inputs") == cell.method:
                value = row.get(cell.column)
                return None if value is None else float(value)
    return None
