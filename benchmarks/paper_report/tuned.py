"""ALPS and its baselines with settings searched for each: what was found, and what it is worth on the tables' seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sprung.benchmarks.paper_report.comparisons import compare_by_seed
from sprung.benchmarks.paper_report.tables import head, line
from sprung.benchmarks.tuning import AS_ALPS, METHODS, TASKS

FIGURE = "SE_affine"

Rows = Sequence[dict[str, Any]]


def tuned_table(rows: Rows) -> str:
    """Markdown table, a line per task and method.

    rows: those of the task `tuning`, and of ALPS and the baselines.  The search: SE of every trial over that with the
    settings found by hand.  Then the best one over the method as it was, and a baseline's over ALPS as it was and over
    ALPS tuned, by seed.
    """
    searched = [row for row in rows if row["task"] == "tuning"]
    columns = (
        "task",
        "method",
        "search",
        "tuned over untuned",
        "over alps",
        "over tuned alps",
        "of each seed",
        "p, seeds",
    )
    lines = head(*columns)
    for task in (known.name for known in TASKS):
        best = [
            row | {"task": task, "method": _tuned(method)}
            for method in METHODS
            for row in searched
            if row["method"] == f"{task} {method} tuned"
        ]
        for method in METHODS:
            own = [row for row in searched if row["method"] == f"{task} {method}, {row['trial']}"]
            trials = {row["trial"]: float(row.get(FIGURE, "inf")) for row in own}  # inf: it diverged
            if trials:
                search = ", ".join(
                    f"{name} {se / trials[AS_ALPS]:.3g}" for name, se in trials.items() if name != AS_ALPS
                )
                lines.append(line(task, method, search, *_over([*rows, *best], task, method)))
    return "\n".join(lines)


def _tuned(method: str) -> str:
    return f"{method}_tuned"


def _over(rows: Rows, task: str, method: str) -> tuple[str, ...]:
    """Ratios of the tuned method to itself, to ALPS and to ALPS tuned, the last of each seed, and p.

    Where no trial was better than the settings found by hand, these are the tuned ones; dashes for ALPS over itself.
    """
    name = _tuned(method)
    own = compare_by_seed(rows, task, name, method, FIGURE)
    if own is None:
        name = method
    ratio = "-" if own is None else f"{own.ratio:.3g}"
    if method == "alps":
        return ratio, "-", "-", "-", "-"
    over = compare_by_seed(rows, task, name, "alps", FIGURE)
    over_tuned = compare_by_seed(rows, task, name, _tuned("alps"), FIGURE) or over
    if over is None or over_tuned is None:
        return ratio, "-", "-", "-", "-"
    each = ", ".join(f"{one:.3g}" for one in over_tuned.by_seed)
    lost = [str(row["seed"]) for row in rows if (row["task"], row.get("method")) == (task, name) and "diverged" in row]
    each += f"; diverged on seed {', '.join(lost)}" if lost else ""
    p = "-" if over_tuned.p_seeds is None else f"{over_tuned.p_seeds:.2g}"
    return ratio, f"{over.ratio:.3g}", f"{over_tuned.ratio:.3g}", each, p
