"""What the fits of one diagnosis may cost: counted, not timed, so that a slow machine says what a fast one does."""

from __future__ import annotations


class WorkBudget:
    """Samples of all models that were linearised, and how many may be.  May be shared among threads."""

    def __init__(self, most: float) -> None:
        self.most = most
        self.done = 0.0

    def add(self, samples: float) -> None:
        """One more linearisation."""
        self.done += samples

    @property
    def ended(self) -> bool:
        """Whether no candidate is fitted any more."""
        return self.done >= self.most
