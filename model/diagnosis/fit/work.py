"""What the fits of one diagnosis may cost: counted, not timed, so that a slow machine says what a fast one does."""

from __future__ import annotations

from collections.abc import Sequence


class WorkBudget:
    """Samples of all models that were linearised, and how many may be.

    Solving a law's loop counts as a share of that for every time the law is asked for its force over the record.
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self.done = 0.0

    def add(self, samples: float) -> None:
        """One more linearisation, or as much of one as a loop takes."""
        self.done += samples

    @property
    def ended(self) -> bool:
        """Whether no candidate is fitted any more."""
        return self.done >= self.most

    def apart(self, count: int) -> list[WorkBudget]:
        """A budget for each of so many threads, all that is left: none depends on how far the others are."""
        return [WorkBudget(self.most - self.done) for _ in range(count)]

    def gather(self, parts: Sequence[WorkBudget]) -> None:
        """Count what threads have spent."""
        self.done += sum(part.done for part in parts)
