"""What the fits of one diagnosis may cost: counted, not timed, so that a slow machine says what a fast one does.

A service that has to end a diagnosis at some time sets a time, too: a search that ends there reports what it found.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence


class WorkBudget:
    """Samples of all models that were linearised, and how many may be.

    Solving a law's balance counts as a share of that for every time the law is asked for its force over the record.
    """

    def __init__(self, most: float, until: float = math.inf) -> None:
        """until: of `time.monotonic`, from which on no candidate is fitted any more."""
        self.most = most
        self.until = until
        self.done = 0.0

    def add(self, samples: float) -> None:
        """One more linearisation, or as much of one as a balance takes."""
        self.done += samples

    @property
    def ended(self) -> bool:
        """Whether no candidate is fitted any more."""
        return self.done >= self.most or time.monotonic() >= self.until

    @property
    def limit(self) -> str:
        """What the search ends at, in words."""
        return "budget of work" if self.done >= self.most else "limit of time"

    def apart(self, count: int) -> list[WorkBudget]:
        """A budget for each of so many threads, all that is left: none depends on how far the others are."""
        return [WorkBudget(self.most - self.done, self.until) for _ in range(count)]

    def gather(self, parts: Sequence[WorkBudget]) -> None:
        """Count what threads have spent."""
        self.done += sum(part.done for part in parts)
