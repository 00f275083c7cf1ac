"""Colours, figures and small drawing habits shared by the pictures of a report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sprung.model.signals import FloatArray
from sprung.replay.whole_file import written_whole

MEASURED = "#22303c"
BEFORE = "#d1495b"  # nominal structure
AFTER = "#0b7a75"  # with what was left out
NOISE = "#8d99a6"
LAW = "#e09f3e"
HIGHLIGHT = "#c1121f"
PAPER = "#ffffff"
QUIET = "#6b7885"

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#9aa5b1",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e8ec",
    "grid.linewidth": 0.7,
    "xtick.color": "#3e4c59",
    "ytick.color": "#3e4c59",
    "legend.frameon": False,
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
DOTS_PER_INCH = 120
NARROW = 4.4  # inches of a picture for phones: letters are then read at 350 pixels


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of the report's look, in inches; no global state, so workers may draw at once."""
    with rc_context(RC):
        figure = Figure(figsize=(width, height), layout="constrained", dpi=DOTS_PER_INCH)
        FigureCanvasAgg(figure)
    return figure


def new_panels(
    rows: int, columns: int, width: float, row_height: float, *, narrow: bool, **grid: Any
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of so many panels and its axes (rows, columns), in inches; narrow: one below the other, for phones.

    grid: further arguments of `Figure.subplots`, for panels beside each other.
    """
    if not narrow:
        figure = new_figure(width, row_height * rows)
        return figure, figure.subplots(rows, columns, squeeze=False, **grid)
    figure = new_figure(NARROW, row_height * rows * columns)
    return figure, figure.subplots(rows * columns, 1, squeeze=False).reshape(rows, columns)


def save(figure: Figure, path: Path) -> Path:
    """The figure as PNG at `path`."""
    with rc_context(RC), written_whole(path) as part:
        figure.savefig(part, dpi=DOTS_PER_INCH)
    return path


def bare(axes: Axes) -> None:
    """Leaves only what is drawn: no frame, no ticks, no grid."""
    axes.set_axis_off()
    axes.grid(False)


def engineering(value: float, digits: int = 3) -> str:
    """1.22e6 as "1.22 M", 395 as "395", 0.23 as it is; for numbers beside a unit."""
    rounded = float(f"{value:.{digits}g}")  # before it is printed, which then needs no exponent
    size = abs(rounded)
    for scale, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if size >= scale:
            return f"{rounded / scale:.6g} {prefix}"
    if size >= 0.01 or size == 0:
        return f"{rounded:.6g}"
    for scale, prefix in ((1e-3, "m"), (1e-6, "µ")):
        if size >= scale:
            return f"{rounded / scale:.6g} {prefix}"
    return f"{rounded:.{digits}g}"


def excerpt(error: FloatArray, samples: int) -> slice:
    """The stretch of so many samples with the largest error, of an error (T,) that may lack some."""
    length = min(samples, len(error))
    power = np.convolve(np.nan_to_num(error) ** 2, np.ones(length), mode="valid")
    start = int(np.argmax(power))
    return slice(start, start + length)
