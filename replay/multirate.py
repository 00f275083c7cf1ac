"""Columns of a table that are sampled at a lower rate, and blank between their samples."""

from __future__ import annotations

import numpy as np

from sprung.model.signals import BoolArray, FloatArray, IntArray

ROWS = 40  # at least, to determine the sampling rate of a column
SLOWER = 1.2  # times the interval of the rows
EVEN, MOST = 0.05, 0.9  # tolerance of an interval, relative; share of intervals within it


class MultirateColumns:
    """Finds the columns of a lower rate from the first rows of a table."""

    def __init__(self) -> None:
        self._which: BoolArray | None = None

    def kept(self, time: IntArray, empty: BoolArray) -> tuple[BoolArray, int]:
        """Which values (n, columns) are samples, the missing ones among them, and how many of these are missing.

        time: ns, shape (n,); empty: shape (n, columns).  A blank in a column of a lower rate is not a missing sample.
        """
        if self._which is None and len(time) >= ROWS:
            self._which = np.array([_is_slower(time, ~column) for column in empty.T], dtype=bool)
        if self._which is None or not self._which.any():
            return np.ones(empty.shape, dtype=bool), int(empty.sum())
        return ~(empty & self._which), int(empty[:, ~self._which].sum())


def slower_than(time: FloatArray, interval: float) -> bool:
    """Whether samples at times (T,) come evenly, but less often than every `interval`, in the unit of their times."""
    between = _intervals(np.sort(time))
    if len(between) < 0.1 * ROWS:
        return False
    own = float(np.median(between))
    return own > SLOWER * interval and float(np.mean(np.abs(between - own) < EVEN * own)) > MOST


def _is_slower(time: IntArray, filled: BoolArray) -> bool:
    """Whether a column's values come evenly, and in fewer rows than there are."""
    rows = _intervals(time.astype(np.float64))
    return not filled.all() and len(rows) > 0 and slower_than(time[filled].astype(np.float64), float(np.median(rows)))


def _intervals(time: FloatArray) -> FloatArray:
    between: FloatArray = np.diff(time)
    return between[between > 0]
