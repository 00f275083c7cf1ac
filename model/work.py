"""Budget of work of one search: counted, not timed, so that results do not depend on the machine.

A service may set a time limit as well; a search that reaches it reports its findings so far.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence


class WorkBudget:
    """Number of samples of all linearised models, and its limit.

    Every evaluation of a law over the record counts as a share of a linearisation.
    """

    def __init__(
        self, most: float = math.inf, until: float = math.inf, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """until: time limit by the clock, s."""
        self.most = most
        self.until = until
        self.clock = clock
        self.done = 0.0

    def add(self, samples: float) -> None:
        """Count a linearisation, or the equivalent share of one."""
        self.done += samples

    @property
    def ended(self) -> bool:
        """Whether the budget or the time limit is exhausted."""
        return self.done >= self.most or self.clock() >= self.until

    @property
    def limit(self) -> str:
        """The limit that was reached, in words."""
        return "budget of work" if self.done >= self.most else "limit of time"

    def apart(self, count: int) -> list[WorkBudget]:
        """Budgets for `count` threads, each with all that is left: independent of the other threads' progress."""
        return [WorkBudget(self.most - self.done, self.until, self.clock) for _ in range(count)]

    def portion(self, share: float) -> WorkBudget:
        """A budget of a share of what is left, for a part of the search that others may not have to wait for."""
        return WorkBudget(share * (self.most - self.done), self.until, self.clock)

    def gather(self, parts: Sequence[WorkBudget]) -> None:
        """Count the work of threads."""
        self.done += sum(part.done for part in parts)
