"""Replay in real time, or at a multiple of it; the clock is an argument."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from sprung.model.signals import SampleBlock

LONGEST_WAIT = 5.0  # s of recorded time; a longer pause in the recording is not waited for
SLICE = 0.05  # s of recorded time that is handed out at once


def paced(
    blocks: Iterable[SampleBlock],
    speed: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> Iterator[SampleBlock]:
    """The blocks in slices of 50 ms of recorded time, each when `speed` times real time has come to it.

    `speed` 0 or infinite passes the blocks on at once and unchanged.
    """
    if speed < 0 or np.isnan(speed):
        raise ValueError(f"speed must be positive (or 0 for as fast as possible), not {speed}")
    if speed == 0 or np.isinf(speed):
        yield from blocks
        return
    begun = clock()
    due = 0.0  # s of recorded time since the first sample, pauses cut short
    newest: int | None = None
    for block in blocks:
        first = int(block.time[0])
        cuts = np.flatnonzero(np.diff(np.maximum(block.time - first, 0) // int(SLICE * 1e9))) + 1
        for piece in np.split(np.arange(len(block.time)), cuts):
            last = int(block.time[piece].max())
            if newest is not None:
                due += min(max((last - newest) / 1e9, 0.0), LONGEST_WAIT)
            newest = last
            wait = begun + due / speed - clock()
            if wait > 0:
                sleep(wait)
            yield SampleBlock(block.time[piece], block.channel[piece], block.value[piece])
