"""Drift of one parameter as inline SVG: posterior mean with its 95 % band, baseline and nominal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from sprung.model.signals import FloatArray
from sprung.service.times import NANOSECONDS, to_iso

WIDTH, HEIGHT = 360, 150
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 22, 22
SMALLEST_SPAN = 0.04  # of the ratio axis: a quiet parameter looks quiet
BAND = 1.96  # standard deviations


@dataclass(frozen=True, slots=True)
class Trace:
    """One parameter over time, as a ratio to nominal."""

    name: str
    time: Sequence[int]  # ns since epoch, shape (n,)
    ratio: FloatArray  # shape (n,)
    std: FloatArray  # shape (n,)
    baseline: float | None  # ratio to nominal
    alarm: str | None


def drift_svg(trace: Trace) -> str:
    """The plot; empty where there are fewer than two points."""
    if len(trace.time) < 2:
        return ""
    seconds = (np.asarray(trace.time) - trace.time[0]) / NANOSECONDS
    low, high = trace.ratio - BAND * trace.std, trace.ratio + BAND * trace.std
    settled = slice(len(seconds) // 10, None)  # the first windows' wide band would squeeze the rest
    marks = [] if trace.baseline is None else [trace.baseline]
    bottom = min(float(low[settled].min()), *marks, float("inf"))
    top = max(float(high[settled].max()), *marks, float("-inf"))
    middle, span = (bottom + top) / 2, max(top - bottom, SMALLEST_SPAN) * 1.1
    y0, y1 = middle - span / 2, middle + span / 2

    def x_of(values: FloatArray) -> FloatArray:
        return LEFT + values / max(float(seconds[-1]), 1e-9) * (WIDTH - LEFT - RIGHT)

    def y_of(values: FloatArray | float) -> FloatArray:
        share = (np.clip(values, y0, y1) - y0) / (y1 - y0)
        return HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)

    xs = x_of(seconds)
    band = _points(np.concatenate([xs, xs[::-1]]), np.concatenate([y_of(high), y_of(low)[::-1]]))
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" class="drift {escape(trace.alarm or "")}" role="img" '
        f'aria-label="{escape(trace.name)}: ratio to nominal over time">',
        f'<text x="{LEFT}" y="14" class="name">{escape(trace.name)}</text>',
        *(_tick(float(y_of(v)), f"{v:.3f}") for v in (y0 + span * 0.05, middle, y1 - span * 0.05)),
        f'<polygon class="band" points="{band}"/>',
    ]
    if trace.baseline is not None:
        y = float(y_of(trace.baseline))
        parts.append(f'<line class="baseline" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
    parts.append(f'<polyline class="mean" points="{_points(xs, y_of(trace.ratio))}"/>')
    bottom_y = HEIGHT - 6
    parts.append(f'<text x="{LEFT}" y="{bottom_y}">{to_iso(trace.time[0])[11:19]}</text>')
    parts.append(
        f'<text x="{WIDTH - RIGHT}" y="{bottom_y}" text-anchor="end">{to_iso(trace.time[-1])[11:19]}</text></svg>'
    )
    return "".join(parts)


def _tick(y: float, label: str) -> str:
    return (
        f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text x="{LEFT - 4}" y="{y + 3:.1f}" text-anchor="end">{label}</text>'
    )


def _points(xs: FloatArray, ys: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
