"""Parameters before and after, the bias that missing physics had caused, and where the evidence lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from sprung.model.diagnosis.report.report import Report
from sprung.model.text import some
from sprung.service.report import ink


@dataclass(frozen=True)
class Row:
    """One parameter with and without the findings."""

    name: str
    unit: str
    nominal: float
    before: float
    before_std: float
    after: float | None
    after_std: float | None

    @property
    def bias(self) -> float | None:
        """How much too high the nominal structure read it, as a share."""
        return None if not self.after else self.before / self.after - 1

    @property
    def significant(self) -> bool:
        """The two readings differ by more than three of their standard deviations."""
        if self.after is None or self.after_std is None:
            return False
        found: bool = abs(self.before - self.after) > 3 * np.hypot(self.before_std, self.after_std)
        return found


def rows(report: Report) -> list[Row]:
    """Baseline parameters with their augmented counterparts, in the report's order."""
    after = {p.name: p for p in report.augmented} if report.findings else {}
    out = []
    for p in report.baseline:
        q = after.get(p.name)
        values = (None, None) if q is None else (q.value, q.std)
        out.append(Row(p.name, p.unit, p.nominal, p.value, p.std, *values))
    return out


def largest_bias(report: Report) -> Row | None:
    """The parameter that the missing physics had falsified most; None where nothing moved by 2 %."""
    moved = [r for r in rows(report) if r.bias is not None and r.significant and abs(r.bias) > 0.02]
    return max(moved, key=lambda r: abs(r.bias or 0.0), default=None)


def parameter_figure(report: Report, *, narrow: bool = False) -> Figure | None:
    """Ratio to nominal of every parameter that has one, before and after, one panel per quantity."""
    every = [row for row in rows(report) if row.nominal]
    if not every:
        return None
    quantities = list(dict.fromkeys(r.name.rpartition(".")[2] for r in every))
    with rc_context(ink.RC):
        longest = max(sum(r.name.endswith(q) for r in every) for q in quantities)
        figure, grid = ink.new_panels(1, len(quantities), 10.5, 0.26 * longest + 1.15, narrow=narrow)
        panels = grid[0]
        for number, (axes, quantity) in enumerate(zip(panels, quantities, strict=True)):
            mine = [r for r in every if r.name.endswith("." + quantity)][::-1]
            place = np.arange(len(mine))
            before = np.array([r.before / r.nominal for r in mine])
            axes.axvline(1.0, color="#9aa5b1", lw=1.0)
            if report.findings:
                after = np.array([np.nan if r.after is None else r.after / r.nominal for r in mine])
                axes.hlines(place, before, after, color="#c6ced6", lw=3.5, zorder=1)
            axes.errorbar(
                before,
                place,
                xerr=[2 * r.before_std / r.nominal for r in mine],
                fmt="o",
                ms=5,
                color=ink.BEFORE,
                lw=1.2,
                label="nominal structure",
                zorder=3,
            )
            if report.findings:
                spread = [2 * (r.after_std or 0.0) / r.nominal for r in mine]
                axes.errorbar(
                    after, place, xerr=spread, fmt="o", ms=5, color=ink.AFTER, lw=1.2, label="with finding", zorder=4
                )
            axes.set_yticks(place, [r.name.rpartition(".")[0] for r in mine])
            axes.set_xlabel(f"{quantity} / nominal")
            if number == 0:
                axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=8)
    return figure


def location_figure(report: Report) -> Figure | None:
    """Evidence by place, the strongest first."""
    scores = {k: v for k, v in report.localization.items() if np.isfinite(v)}
    if not scores:
        return None
    best = sorted(scores.items(), key=lambda item: -item[1])[:12][::-1]
    owners = {f.location for f in report.findings}
    with rc_context(ink.RC):
        figure = ink.new_figure(5.2, 0.26 * len(best) + 1.1)
        axes = figure.add_subplot()
        colours = [ink.HIGHLIGHT if name in owners else "#aeb8c2" for name, _ in best]
        axes.barh(np.arange(len(best)), [max(s, 0.0) for _, s in best], color=colours, height=0.66)
        axes.set_yticks(np.arange(len(best)), [some(name.split("|"), 1) for name, _ in best])
        axes.set_xscale("symlog", linthresh=10)
        axes.set_xlabel("best score of any law there (chi-square)")
        axes.set_title("where")
    return figure
