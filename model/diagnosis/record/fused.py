"""Supports whose acceleration is measured beside another quantity of the same motion, and where these contradict.

The motion is the spline that fits all of them with their noises as weights (`model.simulate.fusion`).  What it leaves
of each is noise alone, independent of the motion, and shows the faults of single channels.  In the time domain no end
of the record has to be continued, which an acceleration that is integrated twice would not forgive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import ORDERS
from sprung.model.simulate.fusion import left_by_motion, motion, motion_shares

QUANTITIES = {order: quantity for quantity, order in ORDERS.items() if quantity != "force"}


@dataclass(frozen=True)
class FusedMotion:
    """What is measured of one support, by the derivative that it shows."""

    support: int  # index among the supports
    series: Mapping[int, FloatArray]  # each (T,), m, m/s or m/s^2
    noise: Mapping[int, float]  # standard deviation of one sample, likewise

    def part(self, start: int, stop: int) -> FusedMotion:
        """A stretch of samples."""
        return replace(self, series={order: one[start:stop] for order, one in self.series.items()})

    def changed(self, change: Callable[[FloatArray], FloatArray]) -> FusedMotion:
        """All channels changed alike, as columns (T, 1)."""
        return replace(self, series={order: change(one[:, None])[:, 0] for order, one in self.series.items()})

    def displacement(self, dt: float) -> FloatArray:
        """The displacement that fits all of them, (T,), m."""
        return motion(self.series, dt, self.noise)[0]


@dataclass(frozen=True)
class ParityResiduals:
    """What the common motion leaves of the channels of one support over one part of a recording: parity residuals."""

    support: int
    dt: float
    noise: Mapping[int, float]
    fitted: FloatArray  # each channel of the common motion, in units of its noise, (T, Q)
    left: FloatArray  # of each channel, likewise, (T, Q)
    constant: FloatArray = field(repr=False)  # unit vector: what is left of an acceleration's zero, (T, Q)

    @property
    def orders(self) -> tuple[int, ...]:
        """Derivatives that are measured, in ascending order."""
        return tuple(sorted(self.noise))

    def shares_at(self, omega: FloatArray) -> dict[int, FloatArray]:
        """Share of every channel in the displacement at angular frequencies omega > 0, by order."""
        return motion_shares(omega, self.dt, self.noise)

    def shown(self, order: int) -> tuple[FloatArray, FloatArray]:
        """A channel of the common motion and its rate, each (T,), in the channel's unit and per second."""
        from_motion = self.fitted[:, self.orders.index(order)] * self.noise[order]
        return from_motion, np.gradient(from_motion, self.dt, edge_order=2)

    def score(self, order: int, wrong: FloatArray) -> tuple[float, float]:
        """Product with what is left, and square, of an addition `wrong` (T,) to one channel.

        Both are divided by the variance of what it does not explain, where that is above the noise's.
        """
        added = np.zeros_like(self.left)
        added[:, self.orders.index(order)] = wrong / self.noise[order]
        column = self._levelled(left_by_motion(added[None], self.dt, _key(self.noise))[0])
        product, square = float(np.sum(column * self.left)), float(np.sum(column**2))
        if square <= 1e-9 * float(np.sum(added**2)):
            return 0.0, 0.0
        rest = (self.chi_square - product**2 / square) / self.freedom
        return product / max(1.0, rest), square / max(1.0, rest)

    @property
    def chi_square(self) -> float:
        return float(np.sum(self.left**2))

    @property
    def freedom(self) -> int:
        """Samples that the common motion does not take."""
        return len(self.left) * (len(self.orders) - 1)

    def _levelled(self, column: FloatArray) -> FloatArray:
        return np.asarray(column - self.constant * np.sum(self.constant * column))


def parity_residuals(fused: FusedMotion, dt: float, averaged: int = 1) -> ParityResiduals | None:
    """None where a channel is taken for exact.  averaged: samples as they were recorded in every one of these."""
    if min(fused.noise.values()) <= 0:
        return None
    noise = {order: std / np.sqrt(averaged) for order, std in fused.noise.items()}
    key = _key(noise)
    columns = np.stack([fused.series[order] / std for order, std in key], axis=1)
    zero = np.zeros_like(columns)
    zero[:, -1] = 1.0  # accelerometers have zeros of their own, which the motion does not follow
    left, constant = left_by_motion(np.stack([columns, zero]), dt, key)
    size = float(np.linalg.norm(constant))
    unit = constant / size if size > 0 else constant
    found = ParityResiduals(fused.support, dt, noise, columns - left, left, unit)
    return replace(found, left=found._levelled(left))


def _key(noise: Mapping[int, float]) -> tuple[tuple[int, float], ...]:
    return tuple((order, float(noise[order])) for order in sorted(noise))
