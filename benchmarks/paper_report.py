"""`python -m sprung.benchmarks.paper_report [FOLDER] [DOCUMENT]`: measured rows and pictures into docs/paper.md.

Reads the rows that `sprung bench paper` kept (runs/paper/quick by default) and replaces what stands between
`<!-- rows TASK -->` or `<!-- targets -->` and `<!-- end -->` in the document, so that figures there are never typed by
hand.  Several seeds become mean and standard deviation.  Pictures go to `img/paper/` beside the document.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ORDER = (
    "alps", "no_fourier", "no_attention", "autoencoder", "cdm", "alps_smoothed", "alps_known_sensors",
    "alps_from_sensors", "bound_known_sensors", "bound_from_sensors", "guess_nominal", "force_balance",
    "refined", "output_error", "refined_noisy_inputs", "refined_trajectory", "sensors_refined", "sensors_output_error",
)  # fmt: skip
COLUMNS: dict[str, tuple[str, ...]] = {
    "visual": ("SE", "OE", "PE", "PE_relative", "PE_unseen_relative", "SE_relative", "encoded_relative"),
    "train": ("SE", "SE_relative", "PE", "PE_relative"),
    "train_changing": ("PE_relative", "error_at_bound", "SE", "PE", "windows", "samples", "iterations"),
    "kernels": (
        "first_eigenvalue_share", "eigenvalues_above_0.1_percent_of_first", "upper_half_band_share_of_row_spectrum",
        "row_minimum",
    ),
    "phase": ("magnitude", "phase", "balance", "guess"),
    "features": ("PE_magnitudes", "PE_raw", "PE_unseen_magnitudes", "PE_unseen_raw"),
}  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What a figure of a method must not exceed."""

    task: str
    method: str
    column: str
    paper: float | None
    bound: float


TARGETS = (
    Target("pendulum", "alps", "SE", 86.48, 86.48),
    Target("pendulum", "alps", "PE", 0.06, 0.05),
    Target("mass_spring_damper", "alps", "SE", 0.29, 0.29),
    Target("mass_spring_damper", "alps", "PE", 0.60e6, 0.5e6),
    Target("two_body", "alps", "SE", 0.45, 0.45),
    Target("two_body", "alps", "PE", 0.02, 0.02),
    Target("train", "alps", "SE", 3.02, 3.02),
    Target("train", "alps", "PE_relative", 0.0042, 0.0025),
    Target("train_changing", "refined", "PE_relative", None, 0.0030),
)


def targets(rows: list[dict[str, Any]]) -> str:
    """Markdown table of the targets and what the rows reach, mean over seeds."""
    lines = ["| task | figure | paper | target | reached | |", "|---" * 6 + "|"]
    for target in TARGETS:
        same = [row for row in rows if (row["task"], row.get("method")) == (target.task, target.method)]
        reached = "not run yet"
        met = ""
        if same:
            mean = float(np.mean([row[target.column] for row in same]))
            reached = _cell([row | {"paper": {}} for row in same], target.column)
            met = "yes" if mean <= target.bound else "no"
        paper = "-" if target.paper is None else f"{target.paper:.4g}"
        what = f"{target.method} {target.column}"
        lines.append(f"| {target.task} | {what} | {paper} | {target.bound:.4g} | {reached} | {met} |")
    return "\n".join(lines)


def table(task: str, rows: list[dict[str, Any]]) -> str:
    """Markdown table of a task's rows, the paper's values in brackets where it has them."""
    columns = COLUMNS.get(task, COLUMNS["visual"])
    keys = sorted({_name(row) for row in rows}, key=lambda name: (ORDER.index(name) if name in ORDER else 99, name))
    lines = ["| method | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for key in keys:
        same = [row for row in rows if _name(row) == key]
        lines.append(f"| {key} | " + " | ".join(_cell(same, column) for column in columns) + " |")
    return "\n".join(lines)


def _name(row: dict[str, Any]) -> str:
    return str(row.get("method") or f"{row['inputs']} inputs")


def _cell(rows: list[dict[str, Any]], column: str) -> str:
    values = [row[column] for row in rows if row.get(column) is not None]
    paper = rows[0].get("paper", {}).get(column)
    if not values:
        return "-" if paper is None else f"- ({paper:.4g})"
    text = f"{np.mean(values):.4g}"
    if len(values) > 1:
        text += f" ± {np.std(values, ddof=1):.2g}"
    return text if paper is None else f"{text} ({paper:.4g})"


def main(folder: Path, document: Path) -> None:
    """Refresh the tables of the document and its pictures."""
    found = [json.loads(path.read_text()) for path in sorted((folder / "rows").glob("*.json"))]
    found = [row for row in found if "unfinished" not in row]

    def fill(match: re.Match[str]) -> str:
        task = match.group(1)
        rows = [row for row in found if row["task"] == task]
        return f"<!-- rows {task} -->\n{table(task, rows) if rows else 'not run yet'}\n<!-- end -->"

    text = document.read_text()
    text = re.sub(r"<!-- rows (\w+) -->.*?<!-- end -->", fill, text, flags=re.DOTALL)
    reached = f"<!-- targets -->\n{targets(found)}\n<!-- end -->"
    text = re.sub(r"<!-- targets -->.*?<!-- end -->", lambda _: reached, text, flags=re.DOTALL)
    document.write_text(text)
    images = document.parent / "img" / "paper"
    images.mkdir(parents=True, exist_ok=True)
    for picture in (folder / "pictures").glob("*.png"):
        shutil.copy(picture, images)


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    main(*(given + [Path("runs/paper/quick"), Path("docs/paper.md")][len(given) :]))
