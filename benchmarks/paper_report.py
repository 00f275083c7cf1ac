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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from sprung.benchmarks.paper_settings import sources

ORDER = (
    "zero", "opening", "output_error", "alps", "no_fourier", "no_attention", "autoencoder", "cdm",
    "autoencoder_plain", "cdm_plain", "alps_plain", "no_opening", "no_affine_head", "all_states_shown", "no_phases",
    "no_tempering", "no_falling_prior", "scales_halved", "scales_doubled", "hamiltonian", "decoder_free",
    "alps_smoothed", "alps_known_sensors", "alps_from_sensors", "bound_known_sensors", "bound_from_sensors",
    "guess_nominal", "alps_many", "force_balance", "refined", "refined_noisy_inputs", "refined_trajectory",
    "sensors_refined", "sensors_output_error",
)  # fmt: skip
COLUMNS: dict[str, tuple[str, ...]] = {
    "visual": (
        "SE", "SE_affine", "SE_affine_relative", "OE", "PE", "PE_relative", "PE_unseen_relative", "PE_below_relative",
        "PE_noisy_relative", "forecast_relative",
    ),
    "train": ("SE", "SE_relative", "PE", "PE_relative"),
    "train_changing": ("PE_relative", "error_at_bound", "SE", "PE", "windows", "samples", "iterations"),
    "train_drifting": ("PE_relative", "PE", "windows"),
    "kernels": (
        "first_eigenvalue_share", "eigenvalues_above_0.1_percent_of_first", "upper_half_band_share_of_row_spectrum",
        "row_minimum",
    ),
    "phase": ("magnitude", "phase", "balance", "guess"),
    "features": (
        "PE_training_magnitudes", "PE_magnitudes", "PE_unseen_magnitudes", "PE_training_raw", "PE_raw", "PE_unseen_raw",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What a figure of a method must not exceed.

    `comparable`: the paper fixes the units, so that its value is a bar, hit or missed; else it is shown and not judged.
    """

    task: str
    method: str
    column: str
    paper: float | None
    bound: float | None
    comparable: bool = True


TARGETS = (
    Target("pendulum", "alps", "SE", 86.48, 86.48),
    Target("pendulum", "alps", "PE", 0.06, 0.05),
    Target("mass_spring_damper", "alps", "SE", 0.29, None, comparable=False),
    Target("mass_spring_damper", "alps", "PE", 0.60e6, 0.5e6),
    Target("two_body", "alps", "SE", 0.45, None, comparable=False),
    Target("two_body", "alps", "PE", 0.02, 0.02),
    Target("train", "alps", "SE", 3.02, None, comparable=False),
    Target("train", "alps", "PE", 0.44e4, None, comparable=False),
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
            reached = _cell([row | {"paper": {}} for row in same], target.column)
            met = "other units" if target.bound is None else "yes" if mean <= target.bound else "no"
        paper, bound = ("-" if value is None else f"{value:.4g}" for value in (target.paper, target.bound))
        what = f"{target.method} {target.column}"
        line = f"| {target.task} | {what} | {paper} | {bound} | {reached} | {met} |"
        lines.append(line if same else kept.get((f"| {target.task}", what), line))
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


def comparisons(task: str, errors: Path, best: str = "alps") -> str:
    """Markdown table: each method against `best` in gauge-free SE and PE, on the same test trajectories and seeds.

    Ratio of the means with a 95 % bootstrap interval over seeds and, within each, trajectories; p of Wilcoxon's
    signed-rank test, paired by trajectory, two-sided, and Holm's correction over the methods of the table.
    """
    found = {name: _errors(errors, task, name) for name in ORDER}
    lines = ["| method | seeds | SE over alps | p | PE over alps | p |", "|---" * 6 + "|"]
    others = [name for name, seeds in found.items() if seeds and name != best and seeds.keys() & found[best].keys()]
    cells = {name: {key: _compared(found[name], found[best], key) for key in ("SE", "PE")} for name in others}
    for key in ("SE", "PE"):
        known = [name for name in others if cells[name][key] is not None]
        order = sorted(known, key=lambda name: cells[name][key].p)  # type: ignore[union-attr]
        highest = 0.0
        for rank, name in enumerate(order):
            compared = cells[name][key]
            assert compared is not None
            highest = max(highest, min(1.0, (len(order) - rank) * compared.p))
            cells[name][key] = replace(compared, p=highest)
    for name in others:
        count = len(found[name].keys() & found[best].keys())
        lines.append(f"| {name} | {count} | " + " | ".join(_compared_cell(cells[name][k]) for k in ("SE", "PE")) + " |")
    return "\n".join(lines)


@dataclass(frozen=True)
class MethodComparison:
    """Errors of one method over those of another."""

    ratio: float
    low: float
    high: float
    p: float


def _compared_cell(compared: MethodComparison | None) -> str:
    if compared is None:
        return "- | -"
    return f"{compared.ratio:.3g} ({compared.low:.3g} to {compared.high:.3g}) | {compared.p:.2g}"


def _errors(folder: Path, task: str, method: str) -> dict[int, dict[str, np.ndarray]]:
    """Errors by trajectory of every seed that was run."""
    found = {}
    for path in sorted(folder.glob(f"{task}-{method}-s*.npz")):
        with np.load(path) as kept:
            found[int(path.stem.rpartition("-s")[2])] = {key: kept[key] for key in kept.files}
    return found


def _compared(
    one: dict[int, dict[str, np.ndarray]], other: dict[int, dict[str, np.ndarray]], key: str, draws: int = 2000
) -> MethodComparison | None:
    pairs = [(one[seed][key], other[seed][key]) for seed in one if seed in other and key in one[seed]]
    if not pairs or key not in next(iter(other.values())):
        return None
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(draws):
        above = below = 0.0
        for pick in rng.integers(len(pairs), size=len(pairs)):
            left, right = pairs[pick]
            rows = rng.integers(len(left), size=len(left))
            above, below = above + left[rows].mean(), below + right[rows].mean()
        ratios.append(above / below)
    left, right = (np.concatenate(side) for side in zip(*pairs, strict=True))
    p = float(stats.wilcoxon(left, right).pvalue) if np.any(left != right) else 1.0
    low, high = np.quantile(ratios, [0.025, 0.975])
    return MethodComparison(float(np.mean(left) / np.mean(right)), float(low), float(high), p)


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Rows that were kept.  Errors: `ValueError` naming those that other code made than what stands here."""
    found = [json.loads(path.read_text()) for path in sorted((folder / "rows").glob("*.json"))]
    found = [row for row in found if "unfinished" not in row]
    stale = sorted({f"{row['task']} {_name(row)}" for row in found if row.get("sources") != sources()})
    if stale:
        raise ValueError(f"{folder}: rows of other code than this: {', '.join(stale)}; run them again or remove them")
    return found


def main(folder: Path, document: Path) -> None:
    """Refresh the tables of the document and its pictures; tasks without rows keep what they have."""
    found = read_rows(folder)

    def fill(match: re.Match[str]) -> str:
        task = match.group(1)
        rows = [row for row in found if row["task"] == task]
        if not rows:
            return match.group(0)
        made = ", ".join(sorted({f"`{row['commit']}`" for row in rows}))
        seeds = sorted({int(row.get("seed", 0)) for row in rows})
        told = f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
        return f"<!-- rows {task} -->\n{table(task, rows)}\n\nMade at {made}, {told}.\n<!-- end -->"

    def against(match: re.Match[str]) -> str:
        task = match.group(1)
        if not any(row["task"] == task for row in found):
            return match.group(0)
        return f"<!-- against {task} -->\n{comparisons(task, folder / 'errors')}\n<!-- end -->"

    text = document.read_text()
    text = re.sub(r"<!-- rows (\w+) -->.*?<!-- end -->", fill, text, flags=re.DOTALL)
    text = re.sub(r"<!-- against (\w+) -->.*?<!-- end -->", against, text, flags=re.DOTALL)

    def reached(match: re.Match[str]) -> str:
        return f"<!-- targets -->\n{targets(found, match.group(1))}\n<!-- end -->"

    text = re.sub(r"<!-- targets -->(.*?)<!-- end -->", reached, text, flags=re.DOTALL)
    document.write_text(text)
    images = document.parent / "img" / "paper"
    images.mkdir(parents=True, exist_ok=True)
    for picture in (folder / "pictures").glob("*.png"):
        shutil.copy(picture, images)


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    try:
        main(*(given + [Path("runs/paper/quick"), Path("docs/paper.md")][len(given) :]))
    except ValueError as error:
        sys.exit(str(error))
