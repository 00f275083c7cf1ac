"""Is the vehicle watched at all?  The share of its latest windows that could be used."""

from __future__ import annotations

from dataclasses import dataclass

MEMORY = 40  # windows that the share remembers: about the last 20 s
ENOUGH = 0.5  # of the windows; below, nobody would see a change in time


@dataclass(frozen=True, slots=True)
class Coverage:
    """Windows that came, used or not, and the share of the latest that could be used."""

    windows: int = 0
    share: float = 0.0

    @property
    def monitored(self) -> bool:
        """Whether enough of what came lately could be used; False before anything came."""
        return self.windows > 0 and self.share >= ENOUGH


def update(coverage: Coverage, *, usable: bool) -> Coverage:
    """After one more window."""
    windows = coverage.windows + 1
    return Coverage(windows, coverage.share + (float(usable) - coverage.share) / min(windows, MEMORY))
