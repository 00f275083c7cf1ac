"""Pictures of measured records: force loops, the force a slide misses, natural frequencies over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sprung.model.diagnosis.api import Report
from sprung.model.signals import FloatArray
from sprung.service.report import ink


def loops(report: Report, name: str, folder: Path) -> Path:
    """Writes NAME.png: a component's force, measured and modelled, of the part that no fit saw."""
    arrays = report.plot_data
    measured, modelled = arrays["validation.measured"][:, 0], arrays["validation.augmented"][:, 0]
    nominal = arrays["validation.baseline"][:, 0]
    time = arrays["validation.time"]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure = ink.new_figure(9.0, 3.0)
    axes = figure.subplots(1, 3)
    for at, key, unit in ((0, "deflection", "m"), (1, "rate", "m/s")):
        if f"finding.0.{key}" not in arrays:
            continue
        x = np.interp(time, arrays["finding.0.time"], arrays[f"finding.0.{key}"])
        axes[at].plot(x, measured, lw=1.6, color=ink.NOISE)
        axes[at].plot(x, modelled, lw=0.9, color=ink.AFTER)
        axes[at].set_xlabel(f"{key}, {unit}")
        axes[at].locator_params(axis="x", nbins=5)
    axes[0].set_ylabel("force, N")
    axes[2].plot(time, measured, lw=1.6, color=ink.NOISE, label="measured")
    axes[2].plot(time, nominal, lw=0.8, color=ink.BEFORE, label="spring and damper")
    axes[2].plot(time, modelled, lw=0.9, color=ink.AFTER, label="with the laws found")
    axes[2].set_xlabel("time, s")
    axes[2].legend(fontsize=7)
    return ink.save(figure, path)


def missing_force(report: Report, name: str, folder: Path) -> Path:
    """Writes NAME.png: the force that the nominal structure misses over the rate, and the position that no fit saw."""
    arrays = report.plot_data
    folder.mkdir(parents=True, exist_ok=True)
    figure = ink.new_figure(9.0, 3.0)
    left, right = figure.subplots(1, 2)
    rate = arrays["finding.0.rate"]
    left.plot(rate, arrays["finding.0.force_before"], ".", ms=1.5, color=ink.BEFORE, label="missing")
    left.plot(rate, arrays["finding.0.force_after"], ".", ms=1.5, color=ink.AFTER, label="left with the law found")
    left.set_xlabel("rate, m/s")
    left.set_ylabel("force, N")
    left.legend(fontsize=7)
    time = arrays["validation.time"]
    right.plot(time, arrays["validation.measured"][:, 0], lw=1.6, color=ink.NOISE, label="measured")
    right.plot(time, arrays["validation.baseline"][:, 0], lw=0.8, color=ink.BEFORE, label="as the file has it")
    right.plot(time, arrays["validation.augmented"][:, 0], lw=0.9, color=ink.AFTER, label="with what was found")
    right.set_xlabel("time, s")
    right.set_ylabel("position, m")
    right.legend(fontsize=7)
    return ink.save(figure, folder / f"{name}.png")


def frequencies(report: Report, name: str, folder: Path, peaks: FloatArray, independent: FloatArray) -> Path:
    """Writes NAME.png: the lowest natural frequency of every window, its spectral peak, and what it must follow."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = ink.new_figure(9.0, 3.0)
    left, right = figure.subplots(1, 2)
    time = np.array([(point.begin + point.end) / 2 for point in report.track])
    found = np.array([point.frequency[0] for point in report.track])
    deviation = np.array([point.deviation[0] for point in report.track])
    left.plot(time, peaks, "o", ms=4, mfc="none", color=ink.NOISE, label="spectral peak")
    left.errorbar(time, found, deviation, fmt=".", ms=4, lw=0.8, color=ink.AFTER, label="identified")
    left.set_xlabel("time, s")
    left.set_ylabel("natural frequency, Hz")
    left.set_ylim(0.9 * peaks.min(), 1.1 * peaks.max())
    left.legend(fontsize=7)
    right.plot(independent, peaks, "o", ms=4, mfc="none", color=ink.NOISE)
    right.errorbar(independent, found, deviation, fmt=".", ms=4, lw=0.8, color=ink.AFTER)
    right.set_xlabel("position of the pin, V (no diagnosis sees it)")
    right.set_ylim(*left.get_ylim())
    return ink.save(figure, folder / f"{name}.png")
