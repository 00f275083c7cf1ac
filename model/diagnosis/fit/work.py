"""What the fits of one diagnosis may cost: counted, not timed, so that a slow machine says what a fast one does."""

from __future__ import annotations

import threading


class WorkBudget:
    """Samples of all models that were linearised, and how many may be.  May be shared among threads.

    Solving a law's loop counts as a share of that for every time the law is asked for its force over the record.
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self.done = 0.0
        self._lock = threading.Lock()

    def add(self, samples: float) -> None:
        """One more linearisation, or as much of one as a loop takes."""
        with self._lock:
            self.done += samples

    @property
    def ended(self) -> bool:
        """Whether no candidate is fitted any more."""
        return self.done >= self.most
