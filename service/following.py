"""One vehicle's windows through the tracker, in the order in which they come."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sprung.model.signals import Conditions, Estimate, Window
from sprung.model.tracking.tracker import Tracker, TrackerState
from sprung.service.times import AHEAD


@dataclass(frozen=True, slots=True)
class Followed:
    """How far a vehicle has been followed."""

    state: TrackerState
    last: int = -1  # ns, start of the newest window that the tracker has seen

    def after(
        self,
        tracker: Tracker,
        window: Window,
        estimate: Estimate | None,
        now: int,
        conditions: Conditions | None = None,
    ) -> Followed:
        """After one more window; itself where the window is older than what the tracker has seen.

        An older one is followed all the same when the clock must have been wrong: where the clock of its stream
        stepped back, and where the last window is stamped in the future.
        estimate: None for a window that was dropped; it passes the time only.  now: ns, the clock of this host.
        """
        at = self
        if window.start <= at.last and (window.new_segment or at.last > now + AHEAD):
            at = Followed(tracker.rebase(at.state, window.start), window.start - 1)
        if window.start <= at.last:
            return at
        if estimate is None:
            return replace(at, state=tracker.missed(at.state))
        return Followed(tracker.update(at.state, estimate, window.start, conditions), window.start)
