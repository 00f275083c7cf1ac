"""Estimates from elsewhere into trackers and store: in order of time, each window once despite redelivery.

At-least-once delivery becomes one effect: a transaction holds the vehicle, leaves out what is stored or waits already,
folds due windows, keeps the rest waiting, and commits all of it together.  The sender is answered after that.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sprung.service.errors import UserError
from sprung.service.fleet.message import IngestResult, Message, OtherModel, WindowEstimate, decode, encode
from sprung.service.fleet.plausible import impossible
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import FoldedWindows, HeldVehicle, WindowsToFold
from sprung.service.store import pending
from sprung.service.store.partitions import prepare
from sprung.service.store.pending import Waiting
from sprung.service.store.windows import known_starts, newest_start
from sprung.service.times import AHEAD, FIRST_TIME, NANOSECONDS, now_ns, to_iso

log = logging.getLogger("sprung.ingest")
SWEEP_SECONDS = 1.0
CONTIGUOUS = 1.01  # hops: a window that begins so long after the last one follows it


class Ingest:
    """Takes messages.  Safe to share between threads; several processes may do the same on one PostgreSQL store."""

    def __init__(self, pipeline: Pipeline, late_seconds: float, clock: Callable[[], int] = now_ns) -> None:
        """late_seconds: how long a window waits for those before it, in the data's time or this machine's."""
        system = pipeline.engine.system
        self._pipeline = pipeline
        self._late = round(late_seconds * NANOSECONDS)
        self._hop = CONTIGUOUS * system.hop / system.sample_rate * NANOSECONDS
        self._clock = clock
        self._stopping = threading.Event()
        self._sweeper = threading.Thread(target=self._sweep_on, name="sprung-sweep", daemon=True)

    def take(self, messages: Sequence[Message]) -> list[IngestResult]:
        """Fold messages of any vehicles in one transaction; they are stored when this returns.

        A window with numbers that cannot be is dropped, with the reason.  Raises UserError for a message that cannot
        be folded, before anything is stored.
        """
        now = self._clock()
        for message in messages:
            _check_times(message, now)
        prepare(self._pipeline.store, (w.start for message in messages for w in message.windows))
        taken: dict[int, IngestResult] = {}
        folded: list[FoldedWindows] = []
        with self._pipeline.store.write() as connection:
            held = self._pipeline.hold_all(connection, {message.vehicle for message in messages})
            sound = [_sound(message, held[message.vehicle].served.engine) for message in messages]
            for turn in _turns(messages):
                asked = [sound[i] for i in turn]
                done = self._fold_due(connection, asked, held, now)
                for i, message, (one, changed) in zip(turn, asked, done, strict=True):
                    taken[i] = one
                    if changed is not None:
                        held[message.vehicle] = changed.after
                        folded.append(changed)
        self._settle(folded)
        faults = {vehicle: at.known_faults() for vehicle, at in held.items()}
        return [replace(taken[i], faults=faults[message.vehicle]) for i, message in enumerate(messages)]

    def start(self) -> None:
        """Sweep from time to time, in a thread."""
        self._sweeper.start()

    def close(self) -> None:
        """Stop sweeping."""
        self._stopping.set()
        if self._sweeper.is_alive():
            self._sweeper.join()

    def _sweep_on(self) -> None:
        while not self._stopping.wait(max(self._late / NANOSECONDS / 2, SWEEP_SECONDS)):
            try:
                self.sweep()
            except (SQLAlchemyError, OSError):
                log.exception("windows that wait could not be folded; trying again")

    def sweep(self) -> int:
        """Fold windows that have waited long enough; their number."""
        now = self._clock()
        with self._pipeline.store.read() as connection:
            models = self._pipeline.engines.models_in_use(connection)
            overdue = pending.overdue(connection, models, now - self._late, now + AHEAD)
        count = 0
        for vehicle in overdue:
            try:
                count += self._fold_waiting(vehicle, now)
            except (SQLAlchemyError, OSError):
                raise
            except Exception:  # the others have their turn all the same
                log.exception("windows of %s that wait could not be folded; trying again", vehicle)
        return count

    def _fold_waiting(self, vehicle: str, now: int) -> int:
        with self._pipeline.store.write() as connection:
            held = self._pipeline.hold_all(connection, [vehicle])
            [(taken, folded)] = self._fold_due(connection, [Message(vehicle, "", ())], held, now)
        self._settle([] if folded is None else [folded])
        return taken.folded

    def _settle(self, folded: Sequence[FoldedWindows]) -> None:
        for one in folded:
            self._pipeline.settle(one)

    def _fold_due(
        self, connection: Connection, messages: Sequence[Message], held: Mapping[str, HeldVehicle], now: int
    ) -> list[tuple[IngestResult, FoldedWindows | None]]:
        """Fold the due windows of some vehicles, waiting and new ones, each once; keep the rest."""
        models = {message.vehicle: held[message.vehicle].served.model_id for message in messages}
        waited = pending.waiting(connection, models)
        dues = [
            self._due(connection, message, held[message.vehicle], waited.get(message.vehicle, []), now)
            for message in messages
        ]
        folded = iter(self._pipeline.fold_all(connection, [due.to_fold() for due in dues if due.order]))
        for due in dues:
            pending.release(connection, due.message.vehicle, due.at.served.model_id, due.released)
            pending.keep(connection, due.message.vehicle, due.at.served.model_id, due.rest)
        return [(due.taken, next(folded) if due.order else None) for due in dues]

    def _due(
        self, connection: Connection, message: Message, at: HeldVehicle, waited: Sequence[Waiting], now: int
    ) -> DueWindows:
        """What of a vehicle's windows may be folded now."""
        vehicle, model = message.vehicle, at.served.model_id
        newest = at.newest_ns
        if newest is None:
            newest = newest_start(connection, vehicle, model, at.last_window_ns)
            at = replace(at, newest_ns=newest)
        last = max(at.last_window_ns, newest)  # a window that was dropped is no gap
        starts = {row.start for row in waited} | {w.start for w in message.windows}
        older = [start for start in starts if start <= last]
        known = known_starts(connection, vehicle, model, older) if older else set()
        first = {w.start: w for w in reversed(message.windows)}  # of several of one start the first counts
        fresh = [w for w in first.values() if w.start not in known][::-1]
        held = {row.start: row for row in waited if row.start not in known}
        came = {w.start: w for w in fresh if w.start not in held}
        stepped_back = next((i for i, w in enumerate(fresh) if w.new_segment and w.start <= last), None)
        if (
            stepped_back is not None
        ):  # the clock was set back: waiting windows are older, then the rest in order of arrival
            due = sorted((*held, *(w.start for w in fresh[:stepped_back] if w.start in came)))
            due += [w.start for w in fresh[stepped_back:] if w.start in came]
        else:
            received = dict.fromkeys(came, now) | {start: _by(row.received, now) for start, row in held.items()}
            due = due_windows(received, last, self._hop, self._late, now)
        order = [came[start] if start in came else _restored(held[start]) for start in due]
        done = set(due) | known
        digest = at.served.engine.digest
        rest = [
            Waiting(start, now, encode(Message(vehicle, digest, (came[start],)), "exact"))
            for start in sorted(set(came) - set(due))
        ]
        waits = sum(w.start not in done for w in fresh)
        taken = IngestResult(vehicle, len(order), waits, len(message.windows) - len(fresh))
        return DueWindows(message, at, order, [row.start for row in waited if row.start in done], rest, taken)


@dataclass(frozen=True, slots=True)
class DueWindows:
    """What is to become of a vehicle's windows."""

    message: Message
    at: HeldVehicle
    order: list[WindowEstimate]  # to be folded now
    released: list[int]  # starts of those that wait no longer
    rest: list[Waiting]  # that wait from now on
    taken: IngestResult

    def to_fold(self) -> WindowsToFold:
        """As the pipeline takes it."""
        system = self.at.served.engine.system
        windows = [one.window(system.sample_rate, len(system.channels)) for one in self.order]
        return WindowsToFold(self.message.vehicle, windows, [one.estimate for one in self.order], self.at)


def _turns(messages: Sequence[Message]) -> list[list[int]]:
    """Which messages are folded together: of every vehicle one a turn, in the order in which they came."""
    count: Counter[str] = Counter()
    turns: list[list[int]] = []
    for i, message in enumerate(messages):
        turn = count[message.vehicle]
        count[message.vehicle] += 1
        if turn == len(turns):
            turns.append([])
        turns[turn].append(i)
    return turns


def _check_times(message: Message, now: int) -> None:
    for window in message.windows:
        if not FIRST_TIME <= window.start <= now + AHEAD:
            raise UserError(f"window {to_iso(window.start)}: before the year 2000 or in the future")


def _sound(message: Message, engine: Engine) -> Message:
    """A message whose windows have the model's shape, without numbers that cannot be."""
    _same_model(message, engine)
    P, S, H = len(engine.system.tracked), len(engine.system.sensors), len(engine.tracker.deviations)
    beside = len(engine.system.auxiliary)
    for window in message.windows:
        if window.auxiliary is not None and window.auxiliary.shape != (beside,):
            raise UserError(f"{window.auxiliary.size} measurements beside a window came; the system has {beside}")
        e = window.estimate
        if e is None:
            continue
        if e.log_ratio.shape != (P,) or e.per_sensor.shape != (S,):
            raise UserError(f"an estimate of {e.log_ratio.size} parameters and {e.per_sensor.size} sensors came")
        d = e.deviating
        if e.covariance.shape != (P, P) or e.identifiable.shape != (P,):
            raise UserError(f"an estimate with a covariance of shape {e.covariance.shape} came")
        if d is not None and d.given.shape != (P, P):
            raise UserError(f"deviations with a covariance of shape {d.given.shape} came")
        if d is not None and (
            d.score.shape != (H,) or d.cross.shape != (P, H) or d.information.shape != (H, H) or d.point.shape != (H,)
        ):
            raise UserError(f"an estimate of {d.point.size} deviations came; the model has {H}")
    return replace(message, windows=tuple(_plausible(window, engine) for window in message.windows))


def _plausible(window: WindowEstimate, engine: Engine) -> WindowEstimate:
    wrong = impossible(window, engine.system)
    if wrong is None:
        return window
    return WindowEstimate(window.start, "dropped", f"its estimate came with {wrong}", 0, window.new_segment, None)


def _same_model(message: Message, engine: Engine) -> None:
    if message.model != engine.digest:
        raise OtherModel(
            f"the estimates are of model {message.model[:80]!r}, this service follows the vehicle with "
            f"{engine.digest!r}: give both the same system file and weights"
        )


def due_windows(received: dict[int, int], last: int, hop: float, late: int, now: int) -> list[int]:
    """Starts that may be folded now, in order of time.

    received: when the windows that are there came, by their starts, ns.  One that follows the last window without a
    gap, or is older, waits for nothing; behind a gap it waits until a window came that starts `late` ns after it, or
    until it has waited for so long itself.
    """
    order = sorted(received)
    newest = order[-1] if order else 0
    due = []
    for start in order:
        if start - last > hop and newest - start < late and now - received[start] < late:
            break
        due.append(start)
        last = max(last, start)
    return due


def _by(received: int, now: int) -> int:
    """When a window came; long ago, where that lies ahead: the clock has been set back, and nobody waits for it."""
    return received if received <= now + AHEAD else 0


def _restored(row: Waiting) -> WindowEstimate:
    return decode(row.message).windows[0]
