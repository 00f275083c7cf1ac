"""The time order of a stream of samples: late samples, stray time stamps, clock jumps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import IntArray, SampleBlock

PIECE = 1024  # samples looked at together: a stream that leaps to and fro costs no more than its length times this


@dataclass(frozen=True, slots=True)
class Jump:
    """The clock jumped (or the sender paused): what follows starts anew."""

    seconds: float
    at: int  # ns, the first time after it


class Order:
    """Splits blocks where the clock jumps and drops what comes too late.

    A sample belongs to the stream when it is at most `delay` older than the newest one and at most `pause` newer.
    Others wait: once `confirm` of them agree with each other, the clock has jumped (forward or backward);
    when the stream goes on before that, they were stray or late and are dropped.  The result does not depend on
    how the samples are cut into blocks.
    """

    def __init__(self, delay: float, pause: float, confirm: int) -> None:
        self.delay = int(delay * 1e9)
        self.pause = int(pause * 1e9)
        self.confirm = confirm
        self.newest: int | None = None  # ns
        self.counts: Counter[str] = Counter()  # dropped samples by reason
        self._waiting: list[SampleBlock] = []
        self._waiting_count = 0
        self._waiting_newest = 0

    def push(self, block: SampleBlock) -> list[SampleBlock | Jump]:
        """The samples that belong to the stream, with jumps between them."""
        out: list[SampleBlock | Jump] = []
        if self._smooth(block.time):
            return self._whole(block)
        for first in range(0, len(block.time), PIECE):
            self._push(_cut(block, first, first + PIECE), out)
        return out

    def _smooth(self, time: IntArray) -> bool:
        """Whether all of a block belongs to the stream at once."""
        if not len(time) or self.newest is None:
            return False
        newest = np.maximum.accumulate(np.r_[self.newest, time[:-1]])
        step = time - newest
        return bool(step.min() >= -self.delay and step.max() <= self.pause)

    def _whole(self, block: SampleBlock) -> list[SampleBlock | Jump]:
        self.newest = max(self.newest or 0, int(block.time.max()))
        self._discard_waiting()
        return [block]

    def _push(self, rest: SampleBlock, out: list[SampleBlock | Jump]) -> None:
        while len(rest.time):
            if self.newest is None:
                self.newest = int(rest.time[0])
            before = np.maximum.accumulate(np.r_[self.newest, rest.time[:-1]])
            step = rest.time - before
            wrong = (step < -self.delay) | (step > self.pause)
            count = int(np.argmax(wrong)) if wrong.any() else len(rest.time)
            if count:
                out.append(_cut(rest, 0, count))
                self.newest = max(self.newest, int(rest.time[:count].max()))
                self._discard_waiting()
                rest = _cut(rest, count, None)
            else:
                rest = self._wait(rest, out)

    def flush(self) -> None:
        """At the end: what still waits never became a stream."""
        self._discard_waiting()

    def _wait(self, rest: SampleBlock, out: list[SampleBlock | Jump]) -> SampleBlock:
        """Take samples outside the stream one by one until they are confirmed or the stream goes on."""
        newest = self.newest or 0
        for index in range(len(rest.time)):
            time = int(rest.time[index])
            if -self.delay <= time - newest <= self.pause:
                return _cut(rest, index, None)
            if self._waiting_count and not -self.delay <= time - self._waiting_newest <= self.pause:
                self._discard_waiting()
            self._waiting_newest = time if not self._waiting_count else max(self._waiting_newest, time)
            self._waiting.append(_cut(rest, index, index + 1))
            self._waiting_count += 1
            if self._waiting_count >= self.confirm:
                first = int(self._waiting[0].time[0])
                out.append(Jump((first - newest) / 1e9, first))
                out.extend(self._waiting)
                self.newest = self._waiting_newest
                self._waiting, self._waiting_count = [], 0
                return _cut(rest, index + 1, None)
        return _cut(rest, len(rest.time), None)

    def _discard_waiting(self) -> None:
        for block in self._waiting:
            late = self.newest is not None and int(block.time[0]) < self.newest
            self.counts["late" if late else "stray time stamp"] += 1
        self._waiting, self._waiting_count = [], 0


def _cut(block: SampleBlock, start: int, end: int | None) -> SampleBlock:
    return SampleBlock(block.time[start:end], block.channel[start:end], block.value[start:end])
