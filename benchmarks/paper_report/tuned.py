"""Baselines with settings searched for them: what the search found, and what it is worth on the seeds of the tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sprung.benchmarks.paper_report.comparisons import compare_by_seed
from sprung.benchmarks.paper_report.tables import head, line
from sprung.benchmarks.tuned_baselines import AS_ALPS, METHODS, TASKS

FIGURE = "SE_affine"

Rows = Sequence[dict[str, Any]]


def tuned_table(rows: Rows) -> str:
    """Markdown table, a line per task and baseline.

    rows: those of the task `tuning`, and of ALPS and the baselines.  The search: SE of every trial over that with the
    settings of ALPS.  Then the best one, over the baseline as it was and over ALPS, by seed.
    """
    searched = [row for row in rows if row["task"] == "tuning"]
    lines = head("task", "method", "search", "tuned over untuned", "tuned over alps", "of each seed", "p, seeds")
    for task in (known.name for known in TASKS):
        for method in METHODS:
            own = [row for row in searched if row["method"] == f"{task} {method}, {row['trial']}"]
            trials = {row["trial"]: float(row.get(FIGURE, "inf")) for row in own}  # inf: it diverged
            if not trials:
                continue
            search = ", ".join(f"{name} {se / trials[AS_ALPS]:.3g}" for name, se in trials.items() if name != AS_ALPS)
            lines.append(line(task, method, search, *_over(rows, task, method, searched)))
    return "\n".join(lines)


def _over(rows: Rows, task: str, method: str, searched: Rows) -> tuple[str, str, str, str]:
    """Ratios of the tuned baseline to itself and to ALPS, of each seed, and p; dashes where nothing was better."""
    name = f"{method}_tuned"
    best = [row | {"task": task, "method": name} for row in searched if row["method"] == f"{task} {method} tuned"]
    to_itself, to_alps = (compare_by_seed([*rows, *best], task, name, over, FIGURE) for over in (method, "alps"))
    if to_itself is None or to_alps is None:
        return "-", "-", "-", "-"
    p = "-" if to_alps.p_seeds is None else f"{to_alps.p_seeds:.2g}"
    each = ", ".join(f"{ratio:.3g}" for ratio in to_alps.by_seed)
    lost = [str(row["seed"]) for row in best if "diverged" in row]
    each += f"; diverged on seed {', '.join(lost)}" if lost else ""
    return f"{to_itself.ratio:.3g}", f"{to_alps.ratio:.3g}", each, p
