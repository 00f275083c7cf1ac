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

import numpy as np
from scipy import stats

from sprung.benchmarks.paper_report.tables import ORDER, head, line

FIGURES = ("SE", "PE")  # gauge-free SE and PE of each trajectory
DRAWS = 2000  # of the bootstrap

TrajectoryErrors = dict[str, np.ndarray]  # figure: (R,)


@dataclass(frozen=True)
class MethodComparison:
    """Errors of one method over those of another."""

    ratio: float  # of the means over seeds and trajectories
    low: float  # 95 % bootstrap interval over seeds and, within each, trajectories
    high: float
    by_seed: tuple[float, ...]  # ratio of the means of each seed
    p: float  # Wilcoxon's signed-rank test, paired by trajectory, two-sided
    p_seeds: float | None  # Student's test of the logarithm of `by_seed`; None: a single seed, or no difference at all


def comparisons(task: str, errors: Path, best: str = "alps") -> str:
    """Markdown table: each method against `best`, with p of Wilcoxon's test after Holm's correction over the table."""
    compared = _compared_methods(task, errors, best)
    lines = head("method", "seeds", f"SE over {best}", "p", f"PE over {best}", "p")
    adjusted = {key: _adjusted({m: c[key].p for m, c in compared.items() if key in c}) for key in FIGURES}
    for method, found in compared.items():
        cells = []
        for key in FIGURES:
            cells += [_ratio(found[key]), f"{adjusted[key][method]:.2g}"] if key in found else ["-", "-"]
        lines.append(line(method, str(len(found["SE"].by_seed)), *cells))
    return "\n".join(lines)


def comparisons_by_seed(task: str, errors: Path, best: str = "alps", methods: Sequence[str] = ORDER) -> str:
    """The same of some methods, a line for each figure: the ratio of every seed, and p of both tests after Holm's."""
    compared = {m: found for m, found in _compared_methods(task, errors, best).items() if m in methods}
    lines = head("method", "figure", f"over {best}", "of each seed", "p, trajectories", "p, seeds")
    over_rows = {key: _adjusted({m: c[key].p for m, c in compared.items() if key in c}) for key in FIGURES}
    over_seeds = {
        key: _adjusted({m: p for m, c in compared.items() if key in c and (p := c[key].p_seeds) is not None})
        for key in FIGURES
    }
    for method, found in compared.items():
        for key, one in found.items():
            seeds = ", ".join(f"{ratio:.3g}" for ratio in one.by_seed)
            p_seeds = f"{over_seeds[key][method]:.2g}" if method in over_seeds[key] else "-"
            lines.append(line(method, key, _ratio(one), seeds, f"{over_rows[key][method]:.2g}", p_seeds))
    return "\n".join(lines)


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
            found[int(path.stem.rpartition("-s")[2])] = {key: kept[key] for key in kept.files}
    return found


def _compared(
    one: Mapping[int, TrajectoryErrors], other: Mapping[int, TrajectoryErrors], key: str
) -> MethodComparison | None:
    """One method over another in a figure, over the seeds that both have; None where one has no such figure."""
    pairs = [(one[seed][key], other[seed][key]) for seed in one if seed in other and key in one[seed]]
    if not pairs or key not in next(iter(other.values())):
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
        ratio=float(np.mean(left) / np.mean(right)),
        low=float(low),
        high=float(high),
        by_seed=tuple(float(np.mean(a) / np.mean(b)) for a, b in pairs),
        p=float(stats.wilcoxon(left, right).pvalue) if np.any(left != right) else 1.0,
        p_seeds=_over_seeds([float(np.mean(a) / np.mean(b)) for a, b in pairs]),
    )


def _over_seeds(ratios: Sequence[float]) -> float | None:
    """p of Student's test that the logarithm of a ratio has the mean zero over seeds."""
    logarithms = np.log(ratios)
    if len(ratios) < 2 or np.ptp(logarithms) == 0:
        return None
    return float(stats.ttest_1samp(logarithms, 0.0).pvalue)


def _adjusted(p: Mapping[str, float]) -> dict[str, float]:
    """Holm's correction: the p of each of several tests, so that any false rejection among them has that chance."""
    highest, found = 0.0, {}
    for rank, name in enumerate(sorted(p, key=lambda name: p[name])):
        highest = max(highest, min(1.0, (len(p) - rank) * p[name]))
        found[name] = highest
    return found


def _ratio(compared: MethodComparison) -> str:
    return f"{compared.ratio:.3g} ({compared.low:.3g} to {compared.high:.3g})"
