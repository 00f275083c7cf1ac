"""Measured against simulated on the held-out part: in time, in frequency, sensor by sensor."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import signal

from sprung.model.diagnosis.report.report import Report
from sprung.service.report import ink

Array = NDArray[np.float64]

SHOWN = 3  # sensors drawn in time and frequency
EXCERPT = 400  # samples drawn in time


def _shown_sensors(measured: Array, baseline: Array, augmented: Array) -> list[int]:
    """The sensors that gain most, or fit worst where nothing was added."""
    size = np.sqrt(np.nanmean(measured**2, axis=0)) + 1e-300
    before = np.sqrt(np.nanmean((measured - baseline) ** 2, axis=0)) / size
    after = np.sqrt(np.nanmean((measured - augmented) ** 2, axis=0)) / size
    gain = before**2 - after**2
    rank = gain if np.nanmax(np.abs(gain), initial=0.0) > 1e-12 else before
    best = np.argsort(-np.nan_to_num(rank, nan=-np.inf))[:SHOWN]
    return sorted(int(i) for i in best)


def fit_figure(
    report: Report, sensors: tuple[str, ...], units: tuple[str, ...], rate: float, *, narrow: bool = False
) -> Figure | None:
    """Rows: sensors; left: an excerpt in time with its errors; right: spectra.  None without the arrays."""
    found = report.plot_data
    if "validation.measured" not in found or len(found["validation.measured"]) < 32:
        return None
    measured, baseline = found["validation.measured"], found["validation.baseline"]
    augmented = found.get("validation.augmented", baseline)
    time = found.get("validation.time", np.arange(len(measured)) / rate)
    rows = _shown_sensors(measured, baseline, augmented)
    noise = found.get("validation.noise")
    with rc_context(ink.RC):
        shares = {"width_ratios": [1.45, 1]}
        figure, grid = ink.new_panels(len(rows), 2, 10.5, 2.75, narrow=narrow, gridspec_kw=shares)
        for row, (left, right) in zip(rows, grid, strict=True):
            columns = [a[:, row] for a in (measured, baseline, augmented)]
            _time_panel(left, time, columns, f"{sensors[row]}  [{_pretty(units[row])}]", bool(report.findings))
            floor = None if noise is None else float(noise[row])
            _spectrum_panel(right, columns, rate, units[row], floor, bool(report.findings))
        handles, labels = grid[0][1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2 if narrow else 4, fontsize=9)
        for left, right in grid if narrow else grid[-1:]:
            left.set_xlabel("time [s]")
            right.set_xlabel("frequency [Hz]")
    return figure


def _pretty(unit: str) -> str:
    return unit.replace("^2", "²").replace("^3", "³")


def _time_panel(axes: Axes, time: Array, columns: list[Array], title: str, augmented: bool) -> None:
    measured, before, after = columns
    part = ink.excerpt(measured - before, EXCERPT)
    t = time[part]
    axes.plot(t, measured[part], color=ink.MEASURED, lw=1.6, label="measured")
    axes.plot(t, before[part], color=ink.BEFORE, lw=1.0, label="nominal")
    if augmented:
        axes.plot(t, after[part], color=ink.AFTER, lw=1.0, ls=(0, (4, 1.5)), label="with finding")
    span = float(np.nanmax(np.abs(measured[part]))) or 1.0
    offset = -2.1 * span
    largest = float(np.nanmax(np.abs((measured - before)[part]))) or span
    gain = max((g for g in (1, 2, 5, 10, 20, 50, 100) if g * largest <= 0.95 * span), default=1)
    axes.axhline(offset, color="#c6ced6", lw=0.8)
    axes.plot(t, offset + gain * (measured - before)[part], color=ink.BEFORE, lw=0.9)
    if augmented:
        axes.plot(t, offset + gain * (measured - after)[part], color=ink.AFTER, lw=0.9)
    words = f"errors × {gain}" if gain > 1 else "errors"
    axes.text(t[0], offset + 0.95 * span, words, fontsize=8, color=ink.QUIET, va="center")
    axes.set_title(title)
    axes.set_ylim(-3.1 * span, 1.75 * span)
    axes.margins(x=0.01)


def _spectrum_panel(
    axes: Axes, columns: list[Array], rate: float, unit: str, floor: float | None, augmented: bool
) -> None:
    measured, before, after = (np.nan_to_num(c) for c in columns)
    length = min(512, len(measured) // 2)

    def density(values: Array) -> tuple[Array, Array]:
        frequency, power = signal.welch(values - values.mean(), rate, nperseg=length)
        return frequency[1:], np.sqrt(power[1:])

    axes.loglog(*density(measured), color=ink.MEASURED, lw=1.3, label="measured")
    axes.loglog(*density(measured - before), color=ink.BEFORE, lw=1.2, label="error, nominal")
    if augmented:
        axes.loglog(*density(measured - after), color=ink.AFTER, lw=1.2, label="error, with finding")
    if floor is not None and floor > 0:
        axes.axhline(floor * np.sqrt(2 / rate), color=ink.NOISE, lw=1.2, ls=":", label="noise floor")
    axes.set_title(f"spectrum  [{_pretty(unit)}/√Hz]")
    axes.margins(x=0.01)


def sensor_figure(report: Report) -> Figure | None:
    """Relative error of every sensor on the held-out part: before, after, noise floor."""
    before = dict(report.baseline_validation.per_sensor)
    if not before:
        return None
    after, floor = dict(report.augmented_validation.per_sensor), dict(report.noise_floor.per_sensor)
    names = list(before)[::-1]
    with rc_context(ink.RC):
        figure = ink.new_figure(5.2, 0.26 * len(names) + 1.1)
        axes = figure.add_subplot()
        rows = np.arange(len(names))
        low = [after.get(n, before[n]) for n in names]
        axes.hlines(rows, low, [before[n] for n in names], color="#c6ced6", lw=3.5, zorder=1)
        axes.scatter([before[n] for n in names], rows, color=ink.BEFORE, s=34, label="nominal", zorder=3)
        if report.findings:
            axes.scatter(low, rows, color=ink.AFTER, s=34, label="with finding", zorder=4)
        axes.scatter(
            [floor.get(n, np.nan) for n in names],
            rows,
            color=ink.NOISE,
            marker="|",
            s=90,
            lw=2,
            label="noise floor",
            zorder=5,
        )
        axes.set_yticks(rows, names)
        axes.set_xlabel("rms error / rms measured, held-out part")
        axes.set_xlim(left=0)
        axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=3, fontsize=8, columnspacing=1.0)
    return figure
