"""`sprung bench paper-compare TASK`: any two methods, from the errors that `sprung bench paper` keeps.

Ratios of means with a bootstrap interval, and p of both tests of `comparisons.py`, as they are: whoever looks at many
pairs corrects for their number, as the tables of docs/paper.md do.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sprung.benchmarks.paper_report.comparisons import FIGURES, compare
from sprung.service.errors import UserError


def run(task: str, methods: str = "cdm", *, over: str = "alps", data: Path | None = None) -> Iterator[dict[str, Any]]:
    """One dict per method and figure (SE after the affine map, PE): the ratio, its interval, by seed, p of two tests.

    methods: one or several between commas; over: the method that they are held against;
    data: folder of the budget, runs/paper/quick by default.
    """
    folder = (data or Path("runs/paper/quick")) / "errors"
    for method in methods.split(","):
        compared = {figure: compare(folder, task, method, over, figure) for figure in FIGURES}
        if not any(compared.values()):
            raise UserError(f"bench paper-compare: {folder}: no errors of {method} and {over} on {task} from one seed")
        for figure, found in compared.items():
            if found is not None:
                yield {
                    "task": task, "method": method, "over": over, "figure": figure, "seeds": list(found.seeds),
                    "ratio": _rounded(found.ratio), "interval": [_rounded(found.low), _rounded(found.high)],
                    "by_seed": [_rounded(ratio) for ratio in found.by_seed],
                    "p_trajectories": _rounded(found.p),
                    "p_seeds": None if found.p_seeds is None else _rounded(found.p_seeds),
                }  # fmt: skip


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
