"""Values of a channel that stand out from all its changes: a node's errors, and no force or motion.

A single wrong value among thousands outweighs everything that a law explains: the held-out part is then all error.  It
is far from what its neighbours interpolate, while beside it nothing is; so are two of them in a row.  Whatever a rig
does and a filter passes reaches over more samples.  Jumps, as of friction, do not end, and so set the scale from which
wrong values stand out.

A channel that drops out repeats one value exactly, for as long as it takes, which it enters and leaves by such a jump.
What it measured meanwhile is not known: a gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray

_REACH = 2  # neighbours on either side, through which a cubic interpolates
_WIDEST = 2  # wrong values in a row
_REPEATED = 3  # values in a row, of a dropout
_NONE = np.array([], dtype=np.intp)


@dataclass(frozen=True)
class WrongValues:
    """Where a channel shows nothing that it measured."""

    at: NDArray[np.intp]  # the first of wrong values in a row
    width: int = 1  # how many these are at most
    dropouts: tuple[slice, ...] = ()  # in which it repeats one value


def without_wrong_values(series: FloatArray, rules: Rules = RULES) -> tuple[FloatArray, WrongValues]:
    """A series (T,) with its wrong values interpolated and its dropouts as gaps, and where they were; gaps are kept.

    Gaps are NaN.  The series itself is returned where nothing is wrong.
    """
    finite = series[np.isfinite(series)]
    if len(finite) < rules.record.minimum_samples:
        return series, WrongValues(_NONE)
    noise = rules.component.spike_noise * white_noise(finite, rules.white_noise)
    dropouts = _dropouts(series, noise, rules)
    if dropouts:
        series = series.copy()
        for run in dropouts:
            series[run] = np.nan
    for width in range(1, _WIDEST + 1):
        mended, at = _without_spikes(series, width, noise, rules)
        if len(at):
            return mended, WrongValues(at, width, dropouts)
    return series, WrongValues(_NONE, dropouts=dropouts)


def _without_spikes(series: FloatArray, width: int, noise: float, rules: Rules) -> tuple[FloatArray, NDArray[np.intp]]:
    """A series (T,) with wrong values, `width` in a row, interpolated, and the first of each.

    noise: how far off a value has to be in any case.
    """
    away = _away(series, width)
    sizes = np.abs(away).max(axis=1)
    across = np.abs(series[width + 1 :] - series[: -width - 1])  # a step leads from one level to another
    returns = np.zeros(len(series), dtype=bool)
    returns[1:-width] = sizes[1:-width] > across
    largest = _apart(np.where(returns & (sizes > noise), sizes, 0.0), rules.component.spikes, 2 * _REACH + width)
    sizes = sizes[largest]
    if width > 1:
        largest = np.array([_best_place(series, at, width) for at in largest], dtype=np.intp)
    for count in range(len(largest), 0, -1):
        at = largest[:count]
        mended = _mended(series, at, width)
        left = float(np.abs(_away(mended, width)).max())
        if sizes[count - 1] > rules.component.spike * left:
            return mended, np.sort(at)
    return series, _NONE


def _mended(series: FloatArray, at: NDArray[np.intp], width: int) -> FloatArray:
    """A series (T,) with the values in a row that begin at `at` interpolated."""
    mended, away = series.copy(), _away(series, width)
    for offset in range(width):
        mended[at + offset] -= away[at, offset]
    return mended


def _best_place(series: FloatArray, at: int, width: int) -> int:
    """Where values in a row are wrong, near the largest of all deviations: next to them others deviate as much."""
    first = max(0, at - 3 * _REACH - width)
    near = series[first : at + 3 * _REACH + 2 * width]
    places = np.arange(at - width, at + width + 1) - first
    places = places[(places >= _REACH) & (places <= len(near) - _REACH - width)]
    left = [float(np.abs(_away(_mended(near, np.array([place]), width), width)).max()) for place in places]
    return first + int(places[int(np.argmin(left))])


def _away(series: FloatArray, width: int) -> FloatArray:
    """How far values in a row are from what a cubic through their neighbours interpolates, by the first, (T, width).

    0 at the ends and beside gaps.
    """
    whole = np.zeros((len(series), width))
    span = 2 * _REACH + width
    if len(series) >= span:
        at = np.lib.stride_tricks.sliding_window_view(series, span)
        inside, neighbours = at[:, _REACH:-_REACH], np.delete(at, range(_REACH, _REACH + width), axis=1)
        whole[_REACH : _REACH + len(at)] = inside - neighbours @ _interpolating(width)
    whole[~np.isfinite(whole).all(axis=1)] = 0.0
    return whole


def _interpolating(width: int) -> FloatArray:
    """Weights of the neighbours on either side in the values between them, (2 REACH, width)."""
    neighbours = np.array([*range(-_REACH, 0), *range(width, width + _REACH)], dtype=float)
    return np.asarray(np.linalg.solve(np.vander(neighbours).T, np.vander(np.arange(width), 2 * _REACH).T))


def _apart(sizes: FloatArray, count: int, margin: int) -> NDArray[np.intp]:
    """Where the largest of `sizes` (T,) are, largest first: at most so many, and none within a margin of another."""
    rest, found = sizes.copy(), list[int]()
    while len(found) < count and np.any(rest > 0):
        found.append(int(np.argmax(rest)))
        rest[max(0, found[-1] - margin) : found[-1] + margin + 1] = 0.0
    return np.array(found, dtype=np.intp)


def _dropouts(series: FloatArray, noise: float, rules: Rules) -> tuple[slice, ...]:
    """Where a series (T,) repeats one value, longer than any other, between the largest of all its changes.

    These lead away from what it shows before and back to it.  A plateau of a test is reached and left as others are.
    """
    runs = _repeats(series)
    value = series[max(runs, key=_length).start]
    same = [run for run in runs if series[run.start] == value]
    longest = max(_length(run) for run in same)
    if longest < _REPEATED or any(_length(run) >= longest for run in runs if series[run.start] != value):
        return ()
    change = np.diff(series)
    change[~np.isfinite(change)] = 0.0
    inside = [run for run in same if run.start > 0 and run.stop < len(series)]
    jumps = [(change[run.start - 1], -change[run.stop - 1]) for run in inside]
    for run in same:
        change[max(0, run.start - 1) : run.stop] = 0.0
    largest = max(float(np.abs(change).max()), noise)
    stand_out = [min(np.abs(jump)) > largest and np.prod(jump) > 0 for jump in jumps]
    return tuple(inside) if any(stand_out) and len(inside) <= rules.component.spikes else ()


def _repeats(series: FloatArray) -> list[slice]:
    """The runs of one value that a series (T,) consists of; gaps are apart."""
    edges = (np.flatnonzero(np.diff(series) != 0) + 1).tolist()
    return [slice(*pair) for pair in zip([0, *edges], [*edges, len(series)], strict=True)]


def _length(run: slice) -> int:
    return int(run.stop - run.start)
