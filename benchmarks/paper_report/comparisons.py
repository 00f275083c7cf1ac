"""Methods against each other, paired by test trajectory and by seed, from the errors that `sprung bench paper` keeps.

Two questions, two tests.  Whether these trained networks differ: Wilcoxon's signed-rank test over the test
trajectories of all seeds.  Whether the methods differ, whatever data and networks are drawn: Student's paired test over
seeds, of the logarithm of their mean errors; with three seeds it has two degrees of freedom, and says little of small
differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from sprung.benchmarks.paper_report.tables import ORDER, head, line

FIGURES = ("SE", "PE")  # gauge-free SE and PE of each trajectory
AS_PRINTED = (("autoencoder_plain", "autoencoder"), ("cdm_plain", "cdm"))  # over the same with the help that ALPS gets
DRAWS = 2000  # of the bootstrap

TrajectoryErrors = dict[str, np.ndarray]  # figure: (R,)
Rows = Sequence[dict[str, Any]]


@dataclass(frozen=True)
class MethodComparison:
    """Errors of one method over those of another."""

    seeds: tuple[int, ...]  # that both have
    ratio: float  # of the means over seeds and trajectories
    low: float  # 95 % bootstrap interval over seeds and, within each, trajectories
    high: float
    by_seed: tuple[float, ...]  # ratio of the means of each seed
    p: float  # Wilcoxon's signed-rank test, paired by trajectory, two-sided
    p_seeds: float | None  # Student's test of the logarithm of `by_seed`; None: a single seed, or no difference at all


@dataclass(frozen=True)
class SeedComparison:
    """Any figure of the rows of one method over that of another, paired by seed."""

    seeds: tuple[int, ...]  # that both have
    values: tuple[float, ...]
    values_over: tuple[float, ...]
    ratio: float | None  # of the means; None: the other is zero
    by_seed: tuple[float, ...]  # without seeds where the other is zero
    p_seeds: float | None  # as in `MethodComparison`; None also where a figure is not positive


def comparisons(task: str, errors: Path, best: str = "alps") -> str:
    """Markdown table: each method against `best`, with p of both tests after Holm's correction over the table."""
    compared = _compared_methods(task, errors, best)
    columns = [column for key in FIGURES for column in (f"{key} over {best}", "p, trajectories", "p, seeds")]
    lines = head("method", "seeds", *columns)
    corrected = {key: _corrected({m: c[key] for m, c in compared.items() if key in c}) for key in FIGURES}
    for method, found in compared.items():
        cells = []
        for key in FIGURES:
            cells += [_ratio(found[key]), *corrected[key][method]] if key in found else ["-", "-", "-"]
        lines.append(line(method, str(len(found["SE"].by_seed)), *cells))
    return "\n".join(lines)


def comparisons_by_seed(task: str, errors: Path, best: str = "alps", methods: Sequence[str] = ORDER) -> str:
    """The same of some methods, a line for each figure: the ratio of every seed, and p of both tests after Holm's."""
    compared = {m: found for m, found in _compared_methods(task, errors, best).items() if m in methods}
    lines = head("method", "figure", f"over {best}", "of each seed", "p, trajectories", "p, seeds")
    corrected = {key: _corrected({m: c[key] for m, c in compared.items() if key in c}) for key in FIGURES}
    for method, found in compared.items():
        for key, one in found.items():
            lines.append(line(method, key, _ratio(one), _each(one), *corrected[key][method]))
    return "\n".join(lines)


def comparisons_of_pairs(task: str, errors: Path, pairs: Sequence[tuple[str, str]] = AS_PRINTED) -> str:
    """Markdown table: the first method of each pair over its second."""
    lines = head("method", "over", "figure", "ratio", "of each seed", "p, trajectories", "p, seeds")
    for key in FIGURES:
        found = {pair: one for pair in pairs if (one := compare(errors, task, *pair, key)) is not None}
        corrected = _corrected({" ".join(pair): one for pair, one in found.items()})
        for pair, one in found.items():
            lines.append(line(*pair, key, _ratio(one), _each(one), *corrected[" ".join(pair)]))
    return "\n".join(lines)


def comparisons_of_tasks(rows: Rows, tasks: Sequence[str], method: str, over: str, figure: str) -> str | None:
    """Markdown table: one figure of a method over another, a line for each task, p over seeds after Holm's correction.

    None where a task has no rows of both: the correction is for all of them.
    """
    found = {task: compare_by_seed(rows, task, method, over, figure) for task in tasks}
    compared = {task: one for task, one in found.items() if one is not None}
    if len(compared) < len(tasks):
        return None
    return _table_by_seed("task", f"{method} over {over}, {figure}", compared)


def comparisons_of_names(rows: Rows, task: str, pairs: dict[str, tuple[str, str, str]]) -> str | None:
    """The same within one task, a line by name for each method, the other and a figure; those without rows left out."""
    found = {name: compare_by_seed(rows, task, *pair) for name, pair in pairs.items()}
    compared = {name: one for name, one in found.items() if one is not None}
    return _table_by_seed("case", "ratio", compared) if compared else None


def _table_by_seed(first: str, what: str, compared: dict[str, SeedComparison]) -> str:
    p = _adjusted({name: one.p_seeds for name, one in compared.items() if one.p_seeds is not None})
    lines = head(first, what, "of each seed", "p, seeds")
    for name, one in compared.items():
        ratio = "-" if one.ratio is None else f"{one.ratio:.3g}"
        lines.append(line(name, ratio, _each(one), f"{p[name]:.2g}" if name in p else "-"))
    return "\n".join(lines)


def compare_by_seed(rows: Rows, task: str, method: str, over: str, figure: str) -> SeedComparison | None:
    """Any figure of one method over another, over the seeds that both have; None where there is none."""
    one, other = (
        {
            int(row["seed"]): float(row[figure])
            for row in rows
            if (row["task"], row.get("method")) == (task, name) and isinstance(row.get(figure), (int, float))
        }
        for name in (method, over)
    )
    seeds = tuple(sorted(one.keys() & other.keys()))
    if not seeds:
        return None
    above, below = (tuple(values[seed] for seed in seeds) for values in (one, other))
    ratios = tuple(a / b for a, b in zip(above, below, strict=True) if b)
    return SeedComparison(
        seeds=seeds,
        values=above,
        values_over=below,
        ratio=sum(above) / sum(below) if sum(below) else None,
        by_seed=ratios,
        p_seeds=p_over_seeds(ratios) if len(ratios) == len(seeds) and min(ratios) > 0 else None,
    )


def compare(folder: Path, task: str, method: str, over: str, figure: str) -> MethodComparison | None:
    """One method over another in "SE" or "PE", over the seeds that both have; None where nothing can be compared."""
    reference = _errors(folder, task, over)
    return _compared(_errors(folder, task, method), reference, figure) if reference else None


def _compared_methods(task: str, folder: Path, best: str) -> dict[str, dict[str, MethodComparison]]:
    """Every method that shares a seed with `best`, in the order of tables: its comparison by figure."""
    others = {name: _errors(folder, task, name) for name in ORDER if name != best}
    reference = _errors(folder, task, best)
    found = {}
    for name, seeds in others.items():
        if seeds.keys() & reference.keys():
            figures = {key: _compared(seeds, reference, key) for key in FIGURES}
            found[name] = {key: compared for key, compared in figures.items() if compared is not None}
    return found


def _errors(folder: Path, task: str, method: str) -> dict[int, TrajectoryErrors]:
    """Errors by trajectory of every seed that was run."""
    found = {}
    for path in sorted(folder.glob(f"{task}-{method}-s*.npz")):
        with np.load(path) as kept:
            found[int(path.stem.rpartition("-s")[2])] = {key: kept[key].astype(float) for key in kept.files}
    return found


def _compared(
    one: Mapping[int, TrajectoryErrors], other: Mapping[int, TrajectoryErrors], key: str
) -> MethodComparison | None:
    """One method over another in a figure, over the seeds that both have; None where one has no such figure."""
    seeds = tuple(seed for seed in sorted(one) if seed in other and key in one[seed])
    pairs = [(one[seed][key], other[seed][key]) for seed in seeds if key in other[seed]]
    if not pairs:
        return None
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(DRAWS):
        above = below = 0.0
        for pick in rng.integers(len(pairs), size=len(pairs)):
            left, right = pairs[pick]
            rows = rng.integers(len(left), size=len(left))
            above, below = above + left[rows].mean(), below + right[rows].mean()
        ratios.append(above / below)
    low, high = np.quantile(ratios, [0.025, 0.975])
    left, right = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return MethodComparison(
        seeds=seeds,
        ratio=float(np.mean(left) / np.mean(right)),
        low=float(low),
        high=float(high),
        by_seed=tuple(float(np.mean(a) / np.mean(b)) for a, b in pairs),
        p=float(stats.wilcoxon(left, right).pvalue) if np.any(left != right) else 1.0,
        p_seeds=p_over_seeds([float(np.mean(a) / np.mean(b)) for a, b in pairs]),
    )


def p_over_seeds(ratios: Sequence[float]) -> float | None:
    """p of Student's test that the logarithm of a ratio has the mean zero over seeds."""
    logarithms = np.log(ratios)
    if len(ratios) < 2 or np.ptp(logarithms) == 0:
        return None
    return float(stats.ttest_1samp(logarithms, 0.0).pvalue)


def _corrected(compared: Mapping[str, MethodComparison]) -> dict[str, tuple[str, str]]:
    """p over trajectories and over seeds of each method after Holm's correction, as a table says them."""
    rows = _adjusted({name: one.p for name, one in compared.items()})
    seeds = _adjusted({name: one.p_seeds for name, one in compared.items() if one.p_seeds is not None})
    return {name: (f"{rows[name]:.2g}", f"{seeds[name]:.2g}" if name in seeds else "-") for name in compared}


def _adjusted(p: Mapping[str, float]) -> dict[str, float]:
    """Holm's correction: the p of each of several tests, so that any false rejection among them has that chance."""
    highest, found = 0.0, {}
    for rank, name in enumerate(sorted(p, key=lambda name: p[name])):
        highest = max(highest, min(1.0, (len(p) - rank) * p[name]))
        found[name] = highest
    return found


def _each(compared: MethodComparison | SeedComparison) -> str:
    return ", ".join(f"{ratio:.3g}" for ratio in compared.by_seed)


def _ratio(compared: MethodComparison) -> str:
    return f"{compared.ratio:.3g} ({compared.low:.3g} to {compared.high:.3g})"
