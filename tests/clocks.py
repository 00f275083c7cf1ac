"""A host whose clocks are set by the test."""

from __future__ import annotations

from pathlib import Path

from sprung.service.housekeeping import RetentionClock


class Clocks:
    """A host's clocks."""

    def __init__(self, wall: int) -> None:
        self.wall, self.monotonic = wall, 5

    def passed(self, seconds: float, leap: int = 0) -> None:
        self.wall += round(seconds * 1e9) + leap
        self.monotonic += round(seconds * 1e9)

    def retention(self, path: Path, newest: int | None = None) -> RetentionClock:
        return RetentionClock(path, lambda: newest, lambda: self.wall, lambda: self.monotonic)
