"""What becomes of windows on their way: identified, folded into a vehicle's state, stored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from sprung.model.signals import Estimate, MeasurementFault, Window
from sprung.model.text import some
from sprung.model.tracking.tracker import TrackerState
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.views import VehicleView
from sprung.service.store.windows import WindowRecord


@dataclass(slots=True)
class Batch:
    """What became of a batch of windows."""

    vehicle: str
    records: list[WindowRecord]  # one per window, in order of time
    fresh: list[Window]  # those that were not stored before
    late: int  # fresh, but older than what the tracker had seen: stored, not tracked
    state: TrackerState  # after the batch
    served: ServedModel  # with which the vehicle is followed
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    view: VehicleView | None = None  # how the vehicle is seen after it; None: nobody has looked


@dataclass(frozen=True, slots=True)
class IdentifiedBatch:
    """Windows on their way: identified, not yet tracked and stored."""

    vehicle: str
    served: ServedModel  # with which they were identified
    windows: Sequence[Window]
    known: dict[int, WindowRecord]  # those that are stored already, by start
    fresh: list[Window]
    estimates: list[Estimate | None]  # one per fresh window, None where dropped
    faults: tuple[MeasurementFault, ...]  # of the vehicle's measurements, that were put right before
    priority: Priority
    seconds: dict[str, float]  # by stage


class ModelChanged(RuntimeError):
    """While windows were identified the vehicle was given another model."""


class FaultsChanged(RuntimeError):
    """While windows were identified the tracker has learned more of what is wrong with the vehicle's measurements."""

    def __init__(self, faults: tuple[MeasurementFault, ...]) -> None:
        super().__init__(f"now {len(faults)} are known")
        self.faults = faults


NO_EXCITATION = "no excitation: standstill, or too slow to tell anything"


def lost_channels(names: Sequence[str]) -> str:
    """Why a window of a vehicle that runs tells nothing, though its channels `names` are all that is wrong."""
    return f"tells nothing without {some(names, 1)}, or at this speed"


def outcome_of(window: Window, estimate: Estimate | None) -> tuple[str, str | None]:
    """A window's outcome with the reason for it, once it is known."""
    if estimate is None:
        return window.outcome, window.reason
    if not estimate.informative:
        wrong = [channel for fault in estimate.faults for channel in fault.channel.split("|")]
        lost = list(dict.fromkeys(wrong)) if estimate.running else []
        return "uninformative", lost_channels(lost) if lost else NO_EXCITATION
    return (window.outcome if estimate.identified else "dropped"), estimate.reason or window.reason


@dataclass(frozen=True, slots=True)
class HeldVehicle:
    """A vehicle's tracker in memory; trusted only while the stored revision is the same."""

    served: ServedModel
    revision: int
    last_window_ns: int  # start of the newest window that it has seen; -1 before the first
    state: TrackerState
    newest_ns: int | None = None  # start of the newest window that is stored; None: nobody has looked

    def known_faults(self) -> tuple[MeasurementFault, ...]:
        """Of the vehicle's measurements: see `Engine.identify`."""
        return self.served.engine.tracker.known_faults(self.state)

    def with_stored(self, starts: Iterable[int]) -> HeldVehicle:
        """One revision later, with windows stored that start then."""
        newest = None if self.newest_ns is None else max(self.newest_ns, *starts)
        return replace(self, revision=self.revision + 1, newest_ns=newest)


@dataclass(frozen=True, slots=True)
class WindowsToFold:
    """Windows of a vehicle that are to be tracked and stored, none of which is stored."""

    vehicle: str
    windows: Sequence[Window]  # in order of time
    estimates: Sequence[Estimate | None]  # None where dropped
    at: HeldVehicle


@dataclass(frozen=True, slots=True)
class Newcomer:
    """What was last given to a new vehicle."""

    vehicles: int  # there were then
    at: int  # ns
    state: TrackerState


@dataclass(frozen=True, slots=True)
class FoldedWindows:
    """Windows that are tracked and stored in a transaction which may not be committed yet."""

    batch: Batch
    after: HeldVehicle
