"""Anti-aliased 64 x 64 x 3 pictures of simple shapes, vectorised over frames.

Every shape is a signed distance field in pixels; coverage = clamp(0.5 - distance, 0, 1) is the share of a pixel that
a straight edge at that distance covers, so edges move smoothly with the state.  Values are rounded to 8 bits, as a
camera would give them.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

SIZE = 64
Colour = tuple[float, float, float]
CENTRE = (SIZE - 1) / 2


@cache
def _pixels(device: str) -> tuple[Tensor, Tensor]:
    """Column and row of each pixel, float32, shapes (1, 1, 64) and (1, 64, 1)."""
    axis = torch.arange(SIZE, dtype=torch.float32, device=device)
    return axis[None, None, :], axis[None, :, None]


def disc(column: Tensor, row: Tensor, radius: float) -> Tensor:
    """Coverage of discs with centres (M,) in pixels -> (M, 64, 64)."""
    x, y = _pixels(str(column.device))
    squared = (x - column[:, None, None]).square() + (y - row[:, None, None]).square()
    distance = squared.sqrt() - radius
    return (0.5 - distance).clamp(0, 1)


def bar(start: tuple[Tensor, Tensor], end: tuple[Tensor, Tensor], half_width: float) -> Tensor:
    """Coverage of straight bars with round ends between two points (column, row), each (M,) -> (M, 64, 64)."""
    x, y = _pixels(str(start[0].device))
    ax, ay = (v[:, None, None] for v in start)
    dx, dy = (e[:, None, None] - s[:, None, None] for s, e in zip(start, end, strict=True))
    along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy).clamp_min(1e-6)
    along = along.clamp(0, 1)
    distance = ((x - ax - along * dx).square() + (y - ay - along * dy).square()).sqrt() - half_width
    return (0.5 - distance).clamp(0, 1)


def box(column: Tensor, row: Tensor, half_width: float, half_height: float) -> Tensor:
    """Coverage of upright rectangles with centres (M,) -> (M, 64, 64)."""
    x, y = _pixels(str(column.device))
    across = (half_width + 0.5 - (x - column[:, None, None]).abs()).clamp(0, 1)
    upright = (half_height + 0.5 - (y - row[:, None, None]).abs()).clamp(0, 1)
    return across * upright


def compose(layers: list[tuple[Tensor, Colour]], background: Colour = (0.0, 0.0, 0.0)) -> Tensor:
    """Paint layers (coverage (M, 64, 64), colour) over each other -> (M, 3, 64, 64) float32 in [0, 1]."""
    first = layers[0][0]
    picture = torch.empty(len(first), 3, SIZE, SIZE, device=first.device)
    for channel in range(3):
        plane = picture[:, channel].fill_(background[channel])
        for coverage, colour in layers:
            plane += coverage * (colour[channel] - plane)
    return picture.mul_(255).round_().div_(255)
