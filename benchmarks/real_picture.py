"""Force loops of a component test, measured and modelled, of the part that no fit saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sprung.model.diagnosis.api import Report
from sprung.service.report import ink


def loops(report: Report, name: str, folder: Path) -> Path:
    """Writes NAME.png: force over deflection and over rate."""
    arrays = report.evidence
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
