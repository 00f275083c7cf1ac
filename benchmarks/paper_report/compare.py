"""`sprung bench paper-compare TASK`: any two methods in any figure of the rows that `sprung bench paper` made.

SE and PE are compared by trajectory: ratios of means with a bootstrap interval, and p of both tests of
`comparisons.py`; other figures by seed.  p are as they are: whoever looks at many pairs corrects for their number, as
the tables of docs/paper.md do.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from sprung.benchmarks.paper_report.comparisons import FIGURES, compare, compare_by_seed
from sprung.benchmarks.paper_report.document import of_several_arithmetics
from sprung.benchmarks.paper_report.kept import opened
from sprung.benchmarks.paper_sources import MADE_BY
from sprung.service.errors import UserError


def run(
    task: str = "", methods: str = "cdm", *, over: str = "alps", figure: str | None = None, data: Path | None = None,
    kept: str = "core",
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """One dict per method and figure: the ratio, its interval, by seed, p of two tests.

    task: one that has methods to compare, "pendulum";
    methods: one or several between commas; over: the method that they are held against;
    figure: any figure of their rows, "PE_noisy"; SE after the affine map and PE by default;
    data: folder of the budget, "runs/paper/quick"; by default a set of the rows kept in docs/, "core" or "variants".
    """
    if task not in MADE_BY:
        raise UserError(f"bench paper-compare: no task {task!r}; known are {', '.join(MADE_BY)}")
    with opened(kept) if data is None else nullcontext(data) as folder:
        for method in methods.split(","):
            _check_arithmetic(folder, task, (method, over))
            found = _by_trajectory(folder, task, method, over) if figure is None else []
            if figure is not None:
                found = _by_seed(folder, task, method, over, figure)
            if not found:
                what = f" with {figure}" if figure else ""
                raise UserError(
                    f"bench paper-compare: {data or kept}: no rows of {method} and {over} on {task} from one seed{what}"
                )
            for row in found:
                yield {"task": task, "method": method, "over": over} | row


def _by_trajectory(folder: Path, task: str, method: str, over: str) -> list[dict[str, Any]]:
    compared = {figure: compare(folder / "errors", task, method, over, figure) for figure in FIGURES}
    return [
        {
            "figure": figure, "seeds": list(found.seeds), "ratio": _rounded(found.ratio),
            "interval": [_rounded(found.low), _rounded(found.high)],
            "by_seed": [_rounded(ratio) for ratio in found.by_seed], "p_trajectories": _rounded(found.p),
            "p_seeds": None if found.p_seeds is None else _rounded(found.p_seeds),
        }
        for figure, found in compared.items() if found is not None
    ]  # fmt: skip


def _by_seed(folder: Path, task: str, method: str, over: str, figure: str) -> list[dict[str, Any]]:
    found = compare_by_seed(_rows(folder, task), task, method, over, figure)
    if found is None:
        return []
    return [
        {
            "figure": figure, "seeds": list(found.seeds), "values": list(found.values),
            "values_over": list(found.values_over), "ratio": None if found.ratio is None else _rounded(found.ratio),
            "by_seed": [_rounded(ratio) for ratio in found.by_seed],
            "p_seeds": None if found.p_seeds is None else _rounded(found.p_seeds),
        }
    ]  # fmt: skip


def _rows(folder: Path, task: str) -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted((folder / "rows").glob(f"{task}-*.json"))]


def _check_arithmetic(folder: Path, task: str, methods: tuple[str, str]) -> None:
    """Raise UserError where both methods have a row of one seed, and these differ in arithmetic."""
    rows = [row for row in _rows(folder, task) if row["task"] == task and row.get("method") in methods]
    if mixed := of_several_arithmetics(rows):
        raise UserError(
            f"bench paper-compare: {folder}: {' and '.join(methods)} were made with different arithmetic:"
            f" {', '.join(mixed)}"
        )


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
