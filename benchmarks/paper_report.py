"""`python -m benchmarks.paper_report [FOLDER] [DOCUMENT]`: measured rows into the tables of docs/paper.md.

Reads the rows that `sprung bench paper` kept (runs/paper/quick by default) and replaces what stands between
`<!-- rows TASK -->` and `<!-- end -->` in the document, so that figures there are never typed by hand.  Several seeds
become mean and standard deviation.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

ORDER = (
    "alps", "no_fourier", "no_attention", "autoencoder", "cdm", "alps_smoothed", "alps_from_sensors", "guess_nominal",
    "force_balance",
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
}  # fmt: skip


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
    """Refresh the tables of the document."""
    text = document.read_text()

    def fill(match: re.Match[str]) -> str:
        task = match.group(1)
        found = [json.loads(path.read_text()) for path in sorted((folder / "rows").glob("*.json"))]
        rows = [row for row in found if row["task"] == task and "unfinished" not in row]
        return f"<!-- rows {task} -->\n{table(task, rows) if rows else 'not run yet'}\n<!-- end -->"

    document.write_text(re.sub(r"<!-- rows (\w+) -->.*?<!-- end -->", fill, text, flags=re.DOTALL))


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    main(*(given + [Path("runs/paper/quick"), Path("docs/paper.md")][len(given) :]))
