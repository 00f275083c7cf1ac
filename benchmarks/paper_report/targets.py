"""What figures of the paper must not exceed, and what the rows reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sprung.benchmarks.paper_report.tables import cell


@dataclass(frozen=True)
class Target:
    """What a figure of a method must not exceed.

    `bound` is None where the paper does not fix the units: its value is then shown and not judged.
    """

    task: str
    method: str
    column: str
    paper: float | None
    bound: float | None


TARGETS = (
    Target("pendulum", "alps", "SE", 86.48, 86.48),
    Target("pendulum", "alps", "PE", 0.06, 0.05),
    Target("mass_spring_damper", "alps", "SE", 0.29, None),
    Target("mass_spring_damper", "alps", "PE", 0.60e6, 0.5e6),
    Target("two_body", "alps", "SE", 0.45, None),
    Target("two_body", "alps", "PE", 0.02, 0.02),
    Target("train", "alps", "SE", 3.02, None),
    Target("train", "alps", "PE", 0.44e4, None),
    Target("train", "alps", "PE_relative", 0.0042, 0.0025),
    Target("train_changing", "refined", "PE_relative", None, 0.0030),
)


def targets(rows: list[dict[str, Any]], before: str = "") -> str:
    """Markdown table of the targets and what the rows reach, mean over seeds.

    before: the table as it was; a line for which there are no rows stays as it stands there.
    """
    kept = {tuple(line.split(" | ")[:2]): line for line in before.splitlines()}
    lines = ["| task | figure | paper | target | reached | |", "|---" * 6 + "|"]
    for target in TARGETS:
        same = [row for row in rows if (row["task"], row.get("method")) == (target.task, target.method)]
        reached = "not run yet"
        met = ""
        if same:
            mean = float(np.mean([row[target.column] for row in same]))
            reached = cell([row | {"paper": {}} for row in same], target.column)
            met = "other units" if target.bound is None else "yes" if mean <= target.bound else "no"
        paper, bound = ("-" if value is None else f"{value:.4g}" for value in (target.paper, target.bound))
        what = f"{target.method} {target.column}"
        text = f"| {target.task} | {what} | {paper} | {bound} | {reached} | {met} |"
        lines.append(text if same else kept.get((f"| {target.task}", what), text))
    return "\n".join(lines)
