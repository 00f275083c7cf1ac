"""What the located element does that the nominal structure does not: residual forces, force curves, force maps."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sprung.model.diagnosis.report.report import Report
from sprung.service.report import ink

Array = NDArray[np.float64]
BINS = 25


def _get(report: Report, finding: int, key: str) -> NDArray[Any] | None:
    return report.plot_data.get(f"finding.{finding}.{key}")


def _unit(values: Array, base: str) -> tuple[float, str]:
    """Factor and label that bring a quantity to readable numbers: 2.5e-3 m as 2.5 mm."""
    size = float(np.nanmax(np.abs(values), initial=0.0))
    if base in {"m", "m/s"} and size < 0.5:
        return 1e3, "mm" + base[1:]
    if base == "N" and size >= 2e3:
        return 1e-3, "kN"
    return 1.0, base


def _running_median(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Centres, medians and quartiles of y in bins of equal count over x."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    groups = [(x[which == b], y[which == b]) for b in range(len(edges) - 1)]
    rows = [(np.median(gx), *np.quantile(gy, [0.5, 0.25, 0.75])) for gx, gy in groups if gx.size > 3]
    return tuple(np.array(rows).T) if rows else (np.array([]),) * 4


def residual_figure(report: Report, finding: int, *, narrow: bool = False) -> Figure | None:
    """Force that the model misses over deflection and over rate, before and after."""
    d, v = _get(report, finding, "deflection"), _get(report, finding, "rate")
    before, after = _get(report, finding, "force_before"), _get(report, finding, "force_after")
    if d is None or v is None or before is None:
        return None
    place = report.findings[finding].location
    stages = [("before", before, ink.BEFORE)] + ([("after", after, ink.AFTER)] if after is not None else [])
    with rc_context(ink.RC):
        figure, grid = ink.new_panels(len(stages), 2, 10.5, 2.9, narrow=narrow, sharey=True, sharex="col")
        top = float(np.nanquantile(np.abs(before), 0.999)) * 1.15 or 1.0
        scale, unit = _unit(np.array([top]), "N")
        for axes_row, (stage, force, colour) in zip(grid, stages, strict=True):
            for axes, x, base, word in zip(axes_row, (d, v), ("m", "m/s"), ("deflection", "rate"), strict=True):
                factor, x_unit = _unit(x, base)
                axes.scatter(x * factor, force * scale, s=4, alpha=0.22, color=colour, lw=0, rasterized=True)
                centre, middle, low, high = _running_median(x, force)
                axes.fill_between(centre * factor, low * scale, high * scale, color=colour, alpha=0.18, lw=0)
                axes.plot(centre * factor, middle * scale, color=ink.MEASURED, lw=1.8)
                axes.set_ylim(-top * scale, top * scale)
                axes.set_title(f"missing force over {word}, {stage}")
                axes.set_xlabel(f"{word} of {place} [{x_unit}]" if narrow or stage == stages[-1][0] else "")
            for axes in axes_row if narrow else axes_row[:1]:
                axes.set_ylabel(f"force [{unit}]")
    return figure


def force_figure(report: Report, finding: int, *, narrow: bool = False) -> Figure | None:
    """The restoring force found without a law, its band, and the law through it; a map where no law was named."""
    if _get(report, finding, "map_force") is not None and _get(report, finding, "curve_law") is None:
        return _map_figure(report, finding, narrow=narrow)
    x, mean = _get(report, finding, "curve_x"), _get(report, finding, "curve_mean")
    loop = _get(report, finding, "loop_x") is not None
    if (x is None or mean is None) and not loop:
        return None
    with rc_context(ink.RC):
        panels = int(x is not None and mean is not None) + int(loop)
        figure, grid = ink.new_panels(1, panels, 5.4 * panels, 3.7, narrow=narrow)
        axes = list(grid[0])
        if x is not None and mean is not None:
            _curve_panel(axes[0], report, finding, x, mean)
        if loop:
            _loop_panel(axes[-1], report, finding)
    return figure


def _curve_panel(axes: Axes, report: Report, finding: int, x: Array, mean: Array) -> None:
    over_rate = str(_get(report, finding, "curve_axis")) in {"rate", "1"}
    word, base = ("rate", "m/s") if over_rate else ("deflection", "m")
    factor, x_unit = _unit(x, base)
    scale, unit = _unit(mean, "N")
    spread, law = _get(report, finding, "curve_std"), _get(report, finding, "curve_law")
    if spread is not None:
        for width, shade in ((2, 0.16), (1, 0.24)):
            axes.fill_between(
                x * factor,
                (mean - width * spread) * scale,
                (mean + width * spread) * scale,
                color=ink.AFTER,
                alpha=shade,
                lw=0,
                label="± 1 and 2 std" if width == 1 else None,
            )
    axes.plot(x * factor, mean * scale, color=ink.AFTER, lw=1.6, label="identified without a law")
    if law is not None:
        name = report.findings[finding].effect.replace("_", " ")
        axes.plot(x * factor, law * scale, color=ink.LAW, lw=2.4, ls=(0, (5, 1.6)), label=name)
    axes.set_xlabel(f"{word} [{x_unit}]")
    axes.set_ylabel(f"force beyond k d + c v [{unit}]")
    axes.set_title(f"{report.findings[finding].location}: restoring force")
    axes.legend(fontsize=8)


def _loop_panel(axes: Axes, report: Report, finding: int) -> None:
    x, y = _get(report, finding, "loop_x"), _get(report, finding, "loop_y")
    assert x is not None and y is not None
    factor, x_unit = _unit(x, "m")
    scale, unit = _unit(y, "N")
    axes.plot(x * factor, y * scale, color=ink.AFTER, lw=0.7, alpha=0.75)
    axes.set_xlabel(f"deflection [{x_unit}]")
    axes.set_ylabel(f"force of the law [{unit}]")
    axes.set_title(f"{report.findings[finding].location}: loop")


def _map_figure(report: Report, finding: int, *, narrow: bool) -> Figure:
    found = {key: _get(report, finding, key) for key in ("map_d", "map_v", "map_force", "map_std")}
    d, v, force = found["map_d"], found["map_v"], found["map_force"]
    assert d is not None and v is not None and force is not None
    with rc_context(ink.RC):
        spread = found["map_std"]
        columns, width = (2, 10.5) if spread is not None else (1, 5.6)
        figure, grid = ink.new_panels(1, columns, width, 3.9, narrow=narrow)
        panels = list(grid[0])
        x_factor, x_unit = _unit(d, "m")
        y_factor, y_unit = _unit(v, "m/s")
        scale, unit = _unit(force, "N")
        top = float(np.nanmax(np.abs(force))) * scale or 1.0
        formula = report.findings[finding].formula
        drawn = [(panels[0], force, "RdBu_r", -top, formula or "force without a law")]
        if spread is not None:
            drawn.append((panels[1], spread, "Greys", 0.0, "its standard deviation"))
        for axes, values, colours, low, title in drawn:
            image = axes.pcolormesh(
                d * x_factor,
                v * y_factor,
                values * scale,
                cmap=colours,
                vmin=low,
                vmax=top if low < 0 else None,
                shading="nearest",
                rasterized=True,
            )
            figure.colorbar(image, ax=axes, label=unit, pad=0.02)
            axes.set_xlabel(f"deflection [{x_unit}]")
            axes.set_ylabel(f"rate [{y_unit}]")
            axes.set_title(f"{report.findings[finding].location}: {title}")
            axes.grid(False)
    return figure
