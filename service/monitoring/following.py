"""Vehicles' windows through the tracker, in the order in which they come."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import Conditions, Estimate, Window
from sprung.model.tracking.tracker import Tracker, TrackerState
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.processed import HeldVehicle, WindowsToFold, outcome_of
from sprung.service.monitoring.views import in_kg, running
from sprung.service.processes.forked import ForkedFunctions, ProcessEnded
from sprung.service.store.circumstances import WindowCircumstances
from sprung.service.store.standstill import counted
from sprung.service.store.windows import Posterior, StoredEstimate, WindowLoads, WindowRecord
from sprung.service.times import AHEAD

_NO_SAMPLES = np.zeros((0, 0))


@dataclass(frozen=True, slots=True)
class FollowedVehicle:
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
    ) -> FollowedVehicle:
        """After one more window; itself where the window is older than what the tracker has seen.

        An older one is followed all the same when the clock must have been wrong: where the clock of its stream
        stepped back, and where the last window is stamped in the future.
        estimate: None for a window that was dropped; it passes the time only.  now: ns, the clock of this host.
        """
        at = self
        if window.start <= at.last and (window.new_segment or at.last > now + AHEAD):
            at = FollowedVehicle(tracker.rebase(at.state, window.start), window.start - 1)
        if window.start <= at.last:
            return at
        if estimate is None:
            return replace(at, state=tracker.missed(at.state))
        return FollowedVehicle(tracker.update(at.state, estimate, window.start, conditions), window.start)


@dataclass(frozen=True, slots=True)
class FollowedWindows:
    """What has become of windows."""

    followed: FollowedVehicle
    records: list[WindowRecord]
    ran: list[WindowCircumstances]


Following = Callable[[Sequence[WindowsToFold], int], Generator[FollowedWindows, None, None]]


def follow(asked: Iterable[WindowsToFold], now: int) -> Generator[FollowedWindows, None, None]:
    """Feed each vehicle's windows to its tracker, one vehicle after the other.  now: ns, the clock of this host."""
    for one in asked:
        served = one.at.served
        yield _pass(served.engine, served.model_id, _reached(one.at), one.windows, one.estimates, now)


def _reached(at: HeldVehicle) -> FollowedVehicle:
    return FollowedVehicle(at.state, at.last_window_ns)


def _pass(
    engine: Engine,
    model_id: int,
    followed: FollowedVehicle,
    windows: Sequence[Window],
    estimates: Sequence[Estimate | None],
    now: int,
) -> FollowedWindows:
    tracker, system = engine.tracker, engine.system
    named = [load.body for load in system.loads if load.declared]
    records, ran = [], []
    for window, found in zip(windows, estimates, strict=True):
        outcome, reason = outcome_of(window, found)
        estimate = found if found is not None and found.identified else None
        posterior, before = None, followed
        followed = followed.after(tracker, window, estimate, now, system.conditions(window.auxiliary))
        fed = estimate is not None and followed.last == window.start and followed is not before
        if fed and followed.state.used:  # before, there is nothing but the prior: no measurement, not drawn as one
            posterior = Posterior(*tracker.posterior(followed.state))
        # At a stop the load is that of the ride before, and any other is possible.
        known = fed and tracker.loads_as_of(followed.state) is None
        loads = in_kg(engine, tracker.loads(followed.state)) if known else {}
        alone = {} if estimate is None else in_kg(engine, tracker.loads_of_window(estimate))
        stood = counted(outcome, model_id) if posterior is not None else {}
        ran.append(WindowCircumstances(window.start, running(system, window, loads) | stood))
        solved = None if estimate is None else StoredEstimate.of(estimate)
        record = WindowRecord(window.start, outcome, reason, window.repaired_samples, fed, solved, posterior)
        kept = WindowLoads(
            *(
                {body: loads_of_body[body] for body in named if body in loads_of_body}
                for loads_of_body in (alone, loads)
            )
        )
        records.append(replace(record, loads=kept))
    return FollowedWindows(followed, records, ran)


class FollowingApart:
    """`follow` in a process of its own, see `service.processes.forked`; here while that has none.

    The process keeps the states that it has made last, so that they are sent in one direction only.
    """

    def __init__(self, engine: Engine, vehicles: int) -> None:
        """engine: of the service's system file; vehicles with another one are followed here.  vehicles: kept there."""
        self._tracker = engine.tracker
        self._most = vehicles
        self._there: OrderedDict[_Key, TrackerState] = OrderedDict()  # what the process knows
        self._process = 0  # whose knowledge that is
        self._lock = threading.Lock()
        self.forked = ForkedFunctions("tracks vehicles", {"follow": _Follower(engine).follow})

    def __call__(self, asked: Sequence[WindowsToFold], now: int) -> Generator[FollowedWindows, None, None]:
        """As `follow`; the process works on the next vehicle while the caller does something with one."""
        with self._lock, self.forked.undisturbed() as process:
            if process != self._process:
                self._there.clear()
                self._process = process
            with closing(self._apart([one for one in asked if self._is_mine(one)], now)) as apart:
                for one in asked:
                    yield next(apart if self._is_mine(one) else follow([one], now))

    def _apart(self, asked: Sequence[WindowsToFold], now: int) -> Generator[FollowedWindows, None, None]:
        """Of vehicles that the process follows."""
        if not asked:
            return
        left = [((one.vehicle, one.at.served.model_id), one) for one in asked]
        sent, gone = [self._sent(key, one) for key, one in left], self._too_many([key for key, _ in left])
        try:
            with closing(self.forked.each("follow", sent, gone, now)) as each:
                for passed in each:
                    key, _ = left.pop(0)
                    self._there[key] = passed.followed.state
                    self._there.move_to_end(key)
                    yield passed
        except ProcessEnded:
            yield from follow([one for _, one in left], now)
        except BaseException:  # nobody knows here what the process has made of those that are left
            for key, _ in left:
                self._there.pop(key, None)
            raise

    def _is_mine(self, one: WindowsToFold) -> bool:
        return one.at.served.engine.tracker is self._tracker

    def _sent(self, key: _Key, one: WindowsToFold) -> _Sent:
        known = self._there.get(key) is one.at.state
        windows = [replace(window, values=_NO_SAMPLES) for window in one.windows]
        return key, None if known else one.at.state, one.at.last_window_ns, windows, one.estimates

    def _too_many(self, keys: Sequence[_Key]) -> list[_Key]:
        """States that the process is to forget, heard of longest ago."""
        surplus = len(self._there.keys() | set(keys)) - self._most
        gone = [key for key in self._there if key not in keys][: max(0, surplus)]
        for key in gone:
            del self._there[key]
        return gone


class _Follower:
    """In the process."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._states: dict[_Key, TrackerState] = {}

    def follow(self, sent: Sequence[_Sent], gone: Sequence[_Key], now: int) -> Iterator[FollowedWindows]:
        for key in gone:
            self._states.pop(key, None)
        for key, state, last, windows, estimates in sent:
            at = FollowedVehicle(self._states[key] if state is None else state, last)
            passed = _pass(self._engine, key[1], at, windows, estimates, now)
            self._states[key] = passed.followed.state
            yield passed


_Key = tuple[str, int]  # vehicle, row of `models`
_Sent = tuple[_Key, TrackerState | None, int, list[Window], Sequence[Estimate | None]]  # None: the one that is there
