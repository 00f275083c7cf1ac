"""The time order of a stream of samples: late samples, stray time stamps, clock jumps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import SampleBlock


@dataclass(frozen=True, slots=True)
class ClockJump:
    """The clock jumped (or the sender paused): what follows starts anew."""

    seconds: float
    at: int  # ns, the first time after it


class Reorderer:
    """Splits blocks where the clock jumps, and drops late samples.

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
        self._waiting: list[tuple[int, int, float]] = []  # time, channel, value
        self._waiting_newest = 0

    def push(self, block: SampleBlock) -> list[SampleBlock | ClockJump]:
        """The samples that belong to the stream, with jumps between them."""
        if not len(block.time):
            return []
        newest = int(block.time[0]) if self.newest is None else self.newest
        step = block.time - np.maximum.accumulate(np.r_[newest, block.time[:-1]])
        if step.min() >= -self.delay and step.max() <= self.pause:  # the usual case, in one piece
            self.newest = max(newest, int(block.time.max()))
            self._discard_waiting()
            return [block]
        return self._one_by_one(block, newest)

    def flush(self) -> None:
        """At the end: what still waits never became a stream."""
        self._discard_waiting()

    def _one_by_one(self, block: SampleBlock, newest: int) -> list[SampleBlock | ClockJump]:
        out: list[SampleBlock | ClockJump] = []
        taken: list[int] = []
        for index, time in enumerate(block.time.tolist()):
            if -self.delay <= time - newest <= self.pause:
                newest = self.newest = max(newest, time)
                self._discard_waiting()
                taken.append(index)
                continue
            if self._waiting and not -self.delay <= time - self._waiting_newest <= self.pause:
                self._discard_waiting()
            self._waiting_newest = max(self._waiting_newest, time) if self._waiting else time
            self._waiting.append((time, int(block.channel[index]), float(block.value[index])))
            if len(self._waiting) >= self.confirm:
                out.append(_take(block, taken))
                taken = []
                first = self._waiting[0][0]
                out += [ClockJump((first - newest) / 1e9, first), _joined(self._waiting)]
                newest = self.newest = self._waiting_newest
                self._waiting = []
        out.append(_take(block, taken))
        return [piece for piece in out if isinstance(piece, ClockJump) or len(piece.time)]

    def _discard_waiting(self) -> None:
        for time, _, _ in self._waiting:
            late = self.newest is not None and time < self.newest
            self.counts["late" if late else "stray time stamp"] += 1
        self._waiting = []


def _take(block: SampleBlock, rows: list[int]) -> SampleBlock:
    return SampleBlock(block.time[rows], block.channel[rows], block.value[rows])


def _joined(samples: list[tuple[int, int, float]]) -> SampleBlock:
    time, channel, value = zip(*samples, strict=True)
    return SampleBlock(
        np.array(time, dtype=np.int64), np.array(channel, dtype=np.int32), np.array(value, dtype=np.float64)
    )
