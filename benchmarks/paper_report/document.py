"""Marked places of docs/paper.md, and what is written into each.

A place begins with `<!-- KIND TASK -->` or `<!-- targets -->` and ends with `<!-- end -->`.  Places of tasks without
rows keep what they have.  Pictures go to `img/paper/` beside the document.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sprung.benchmarks.paper_report.comparisons import (
    comparisons,
    comparisons_by_seed,
    comparisons_of_names,
    comparisons_of_pairs,
    comparisons_of_tasks,
)
from sprung.benchmarks.paper_report.tables import explained_table, name_of, seeds_of, table
from sprung.benchmarks.paper_report.targets import targets
from sprung.benchmarks.paper_report.tuned import tuned_table
from sprung.benchmarks.paper_settings import EXTRA
from sprung.benchmarks.paper_sources import is_current

PLACE = re.compile(r"<!-- (?P<kind>\w+)(?: (?P<task>\w+))? -->(?P<before>.*?)<!-- end -->", re.DOTALL)
VISUAL = ("pendulum", "mass_spring_damper", "two_body")
ABLATIONS = ("no_fourier", "no_attention")
VARIANTS = ("alps", *ABLATIONS, *EXTRA)  # beside ALPS: the paper's ablations, as printed, a departure left out, others
COMPARED: dict[str, tuple[tuple[str, str, str], ...]] = {  # method, over which, figure
    "train": (
        ("cdm", "alps", "SE_relative"), ("no_fourier", "alps", "SE_relative"), ("no_fourier", "alps", "PE_relative"),
        ("alps_smoothed", "alps", "SE_relative"), ("alps_smoothed", "alps", "PE_relative"),
    ),
    "train_changing": (
        ("alps", "guess_nominal", "PE_relative"), ("alps_many", "guess_nominal", "PE_relative"),
        ("refined", "guess_nominal", "PE_relative"),
    ),
}  # fmt: skip
Rows = list[dict[str, Any]]


def read_rows(folder: Path) -> Rows:
    """Rows that were kept.  Errors: `ValueError` naming those that other code made than what stands here."""
    found = _all_rows(folder)
    if stale := _stale(found):
        raise ValueError(f"{folder}: rows of other code than this: {', '.join(stale)}; run them again or remove them")
    return found


def _all_rows(folder: Path) -> Rows:
    rows = folder / "rows"
    if not rows.is_dir():
        raise ValueError(f"{rows}: no such folder; `sprung bench paper` makes one")
    found = [json.loads(path.read_text()) for path in sorted(rows.glob("*.json"))]
    return [row for row in found if "unfinished" not in row]


def _stale(rows: Rows) -> list[str]:
    """Task and method of rows that other code made than what stands here."""
    return sorted({f"{row['task']} {name_of(row)}" for row in rows if not is_current(row)})


def of_several_arithmetics(rows: Rows) -> list[str]:
    """Task and seed of rows that were not all made with the same arithmetic: these may not be held against each other.

    Training carries the last bit far, and another processor's sums differ in it.
    """
    found: dict[tuple[str, int], set[str]] = {}
    for row in rows:
        found.setdefault((row["task"], int(row.get("seed") or 0)), set()).add(str(row.get("arithmetic", "")))
    return [f"{task} seed {seed}" for (task, seed), names in sorted(found.items()) if len(names) > 1]


def refresh(folder: Path, document: Path, only: list[str] | None = None) -> list[dict[str, Any]]:
    """Write the document's places and its pictures, or `only` places of these kinds or markers.

    Places of tasks with rows of other code stay as they stand, and are told with these rows.  Errors: `ValueError`
    where no task is left, or where rows of one seed have different arithmetic.
    """
    found = _all_rows(folder)
    if mixed := of_several_arithmetics(found):
        raise ValueError(f"{folder}: rows of one seed with different arithmetic: {', '.join(mixed)}; run them again")
    of_other_code = {task: _stale([row for row in found if row["task"] == task]) for task in {r["task"] for r in found}}
    found = [row for row in found if not of_other_code[row["task"]]]
    if not found:
        read_rows(folder)
        raise ValueError(f"{folder / 'rows'}: no rows of a run that ended")
    filled: list[dict[str, Any]] = []

    def fill(match: re.Match[str]) -> str:
        kind, task, before = match["kind"], match["task"], match["before"]
        marker = kind if task is None else f"{kind} {task}"
        rows = found if task is None else [row for row in found if row["task"] == task]
        wanted = only is None or kind in only or marker in only
        if wanted and kind in KINDS and (stale := of_other_code.get(task or "")):
            filled.append({"place": marker, "rows_of_other_code": stale, "changed": False})
        if not wanted or kind not in KINDS or (task is not None and not rows):
            return match[0]
        text = KINDS[kind](task or "", rows, folder, before)
        filled.append(
            {"place": marker, "rows": len(rows), "seeds": seeds_of(rows), "changed": text != before.strip("\n")}
        )
        return f"<!-- {marker} -->\n{text}\n<!-- end -->"

    document.write_text(PLACE.sub(fill, document.read_text()))
    if only is not None:
        return filled
    images = document.parent / "img" / "paper"
    images.mkdir(parents=True, exist_ok=True)
    for picture in (folder / "pictures").glob("*.png"):
        shutil.copy(picture, images)
    return filled


def _rows_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    del folder, before
    return f"{table(task, rows)}\n\n{_made(rows)}"


def _explained_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """R^2 of each state."""
    del task, folder, before
    return f"{explained_table(rows)}\n\n{_made(rows)}"


def _against_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    del rows, before
    return comparisons(task, folder / "errors")


def _printed_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """The baselines as printed over the same with the help that ALPS gets."""
    del rows, before
    return comparisons_of_pairs(task, folder / "errors")


def _noisy_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """Classical identification over ALPS where pictures are noisy, on every visual task."""
    del task, folder
    return comparisons_of_tasks(rows, VISUAL, "output_error", "alps", "PE_noisy") or before.strip("\n")


def _poor_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """Classical identification over ALPS where both start from an opening that is wrong."""
    del folder
    names = sorted({name_of(row).rpartition(" ")[0] for row in rows})
    pairs = {f"{name}, output_error over alps, PE": (f"{name} output_error", f"{name} alps", "PE") for name in names}
    return comparisons_of_names(rows, task, pairs) or before.strip("\n")


def _tuned_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """The baselines with settings searched for them: the search, and ALPS's seeds with what it found."""
    del task, folder
    tuned = [row for row in rows if row["task"] == "tuning"]
    if not tuned:
        return before.strip("\n")
    return f"{tuned_table(rows)}\n\n{_made(tuned)}"


def _compared_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """Methods of the train against each other: their errors by trajectory are not kept, so that seeds are compared."""
    del folder
    pairs = {f"{method} over {over}, {figure}": (method, over, figure) for method, over, figure in COMPARED[task]}
    return comparisons_of_names(rows, task, pairs) or before.strip("\n")


def _targets_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    del task, folder
    return targets(rows, before)


def _variants_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """Figures of ALPS and its variants, each with its own seeds."""
    del before
    rows = [row for row in rows if name_of(row) in VARIANTS]
    compared = comparisons_by_seed(task, folder / "errors", methods=VARIANTS)
    return f"{table(task, rows)}\n\n{_made(rows)}\n\n{compared}"


def _full_place(task: str, rows: Rows, folder: Path, before: str) -> str:
    """Trained methods of every task with the full budget, which `folder` is then of."""
    del task, folder
    rows = [row | {"method": f"{row['task']} {name_of(row)}"} for row in rows if row.get("budget") == "full"]
    rows = [row for row in rows if "settings" in row]
    return f"{table('visual', rows)}\n\n{_made(rows)}" if rows else before.strip("\n")


KINDS: dict[str, Callable[[str, Rows, Path, str], str]] = {
    "rows": _rows_place,
    "explained": _explained_place,
    "against": _against_place,
    "printed": _printed_place,
    "noisy": _noisy_place,
    "poor": _poor_place,
    "tuned": _tuned_place,
    "compared": _compared_place,
    "targets": _targets_place,
    "variants": _variants_place,
    "full": _full_place,
}


def _made(rows: Rows) -> str:
    """Commits, seeds, and with which vector instructions, of which seeds where they differ."""
    commits = ", ".join(sorted({f"`{row['commit']}`" for row in rows}))
    found: dict[str, Rows] = {}
    for row in rows:
        found.setdefault(str(row.get("arithmetic", "")), []).append(row)
    with_seeds = [
        f"{name} ({_seeds(same)})" if len(found) > 1 else name for name, same in sorted(found.items()) if name
    ]
    return "; ".join([f"Made at {commits}, {_seeds(rows)}", *with_seeds]) + "."


def _seeds(rows: Rows) -> str:
    return f"seed{'s' if ',' in seeds_of(rows) else ''} {seeds_of(rows)}"
