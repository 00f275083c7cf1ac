"""Work that goes on after its request was answered: a thread for each kind, a bounded queue, everything in the store.

What was accepted survives: a job that a stop interrupts is queued again and goes on at the next start (windows are
stored once, so doing a part twice changes nothing).  A job that was at work when the process died, the service's or its
own, is tried once more, and then failed: a recording must not take the service down at every start.  One that the store
or the disk refuses goes on when they take things again.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sprung.model.text import first_line
from sprung.service.errors import Busy, NotFound, UserError
from sprung.service.observability.queues import WaitMetrics
from sprung.service.processes.worker import WorkerKilled
from sprung.service.retrying import message_of, retry
from sprung.service.store import Store, audit, work
from sprung.service.times import NANOSECONDS, now_ns

log = logging.getLogger("sprung.jobs")
T = TypeVar("T")
WORST_MESSAGE = "an unexpected error; the service's log has the details"
MOST_ATTEMPTS = 2
PROGRESS_SECONDS = 1.0  # between two notes of progress in the store
GIVE_UP_SECONDS = 20.0  # within which a cancelled job ends: it is asked several times a second, or after a batch
RETRY_SECONDS = 5.0  # while the store refuses to take what became of a job


class ServiceStopped(Exception):
    """Raised inside a handler when the service stops."""


class Cancelled(Exception):
    """Raised inside a handler when its job was cancelled."""


class Progress:
    """What a handler reports to; `check` also asks it to stop."""

    def __init__(self, note: Callable[[float], None], stopping: threading.Event, seconds: float) -> None:
        """note: takes the share that is done; seconds: that the job may take."""
        self._note = note
        self._stopping = stopping
        self._cancelled = threading.Event()
        self._seconds = seconds
        self._deadline = time.monotonic() + seconds
        self._noted = -PROGRESS_SECONDS
        self._shown = 0.0
        self._reached = 0.0
        self._trouble = ""  # why work was refused last

    def cancel(self) -> None:
        """Make the next `check` raise."""
        self._cancelled.set()

    def check(self) -> None:
        """Raises Stopped when the service stops, Cancelled, or UserError when the job's time is over."""
        if self._stopping.is_set():
            raise ServiceStopped
        if self._cancelled.is_set():
            raise Cancelled
        if time.monotonic() > self._deadline:
            last = f"; last: {self._trouble}" if self._trouble else ""
            raise UserError(f"the job took longer than {self._seconds:.0f} s{last}")
        now = time.monotonic()
        if self._reached >= self._shown + 0.01 and now - self._noted >= PROGRESS_SECONDS:
            self._shown, self._noted = self._reached, now
            self._note(self._shown)

    def retry(self, work: Callable[[], T]) -> T:
        """What `work` returns, tried again while the store or the machine refuses it and the job has time."""

        def noted() -> T:
            try:
                found = work()
            except Exception as error:
                self._trouble = message_of(error)
                raise
            self._trouble = ""
            return found

        return retry(noted, "a job", self.check)

    def step(self, share: float) -> None:
        """`share` of the work is done, 0..1; it is noted now or, when the last note is young, by a later check."""
        self._reached = max(self._reached, min(share, 1.0))
        self.check()


Noted = Callable[[Connection, work.JobRow], None]
Handler = Callable[[work.JobRow, Progress], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Kind:
    """How jobs of a kind are done."""

    run: Handler  # returns the job's result, or raises UserError with a line for the user
    seconds: float  # a job may take


class Jobs:
    """Accepts jobs and works through those of a kind in order; a recording does not wait for a diagnosis of minutes."""

    def __init__(
        self,
        store: Store,
        kinds: Mapping[str, Kind],
        queue_size: int,
        waits: WaitMetrics | None = None,
        aging: Callable[[], int] = now_ns,
    ) -> None:
        """aging: the clock by which files of recordings age, ns since 1970."""
        self._aging = aging
        self._waits = waits
        self._store = store
        self._kinds = kinds
        self._limit = queue_size
        self._queues: dict[str, queue.Queue[str | None]] = {kind: queue.Queue() for kind in kinds}
        self._waiting = 0
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._current: dict[str, Progress] = {}  # of the jobs that run
        self._threads = [
            threading.Thread(target=self._run, args=(waiting,), name=f"sprung-jobs-{kind}", daemon=True)
            for kind, waiting in self._queues.items()
        ]

    @property
    def waiting(self) -> int:
        """Jobs that are accepted and not finished."""
        return self._waiting

    def start(self) -> None:
        """Take up what a previous process left, then wait for more."""
        with self._store.write() as connection:
            left = [job for job in work.unfinished_jobs(connection) if not self._poisonous(connection, job)]
        for job in left:
            self._enqueue(job)
        for thread in self._threads:
            thread.start()

    def reserve(self) -> None:
        """Raise Busy when no further job can be accepted now."""
        if self._waiting >= self._limit or self._stopping.is_set():
            raise Busy(f"{self._waiting} jobs are waiting already; try again later", retry_after=30)

    def submit(
        self,
        kind: str,
        recording: work.RecordingRow | None = None,
        vehicle: str | None = None,
        noted: Noted = lambda connection, job: None,
    ) -> work.JobRow:
        """Accept a job: it is in the store when this returns.  Raises Busy when too many wait.

        One that does the same and has not ended is the answer instead.  noted: called with the answer in the same
        transaction, to write down who asked.
        """
        self.reserve()
        now = now_ns()
        recording_id = None if recording is None else recording.id
        with self._store.write() as connection:
            if recording is not None and work.get_recording(connection, recording.id) is None:
                work.add_recording(connection, replace(recording, kept_since_ns=self._aging()))
            if recording_id is not None:
                waiting = work.waiting_job(connection, kind, recording_id, vehicle)
                if waiting is not None:
                    noted(connection, waiting)
                    return waiting
            job = work.JobRow(work.new_id(), kind, "queued", recording_id, vehicle, 0.0, None, None, now, now)
            work.add_job(connection, job)
            noted(connection, job)
        self._enqueue(job)
        return job

    def cancel(self, job_id: str, by: str) -> work.JobRow:
        """Give a job up, whether it waits or runs.  Raises NotFound; a job that has ended stays as it is."""
        with self._store.write() as connection:
            job = work.get_job(connection, job_id)
            if job is None:
                raise NotFound(f"no job {job_id[:36]!r}")
            audit.record(connection, by, "cancel job", job_id, None, now_ns())
            if job.state in work.UNFINISHED:
                work.update_job(connection, job_id, now_ns(), state="failed", error=f"cancelled by {by}"[:500])
        running = self._current.get(job_id)
        if running is not None:
            running.cancel()
        with self._store.read() as connection:
            return work.get_job(connection, job_id) or job

    def give_up(self, vehicle: str, by: str) -> None:
        """Cancel every job of a vehicle, and wait until none of them runs.  Raises Busy when one does not end."""
        with self._store.read() as connection:
            left = [job.id for job in work.unfinished_jobs(connection) if job.vehicle_id == vehicle]
        for job in left:
            self.cancel(job, by)
        until = time.monotonic() + GIVE_UP_SECONDS
        while any(job in self._current for job in left):
            if time.monotonic() > until:
                raise Busy(f"a job of {vehicle} has not ended yet; try again", retry_after=10)
            time.sleep(0.05)

    def close(self) -> None:
        """Interrupt the running jobs; they and the waiting ones stay queued in the store."""
        self._stopping.set()
        for waiting in self._queues.values():
            waiting.put(None)
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def _poisonous(self, connection: Connection, job: work.JobRow) -> bool:
        """Fail a job that was at work each time when the process died."""
        if job.state != "running" or job.attempts < MOST_ATTEMPTS:
            return False
        error = f"the service died {job.attempts} times while it worked on this; it is not tried again"
        log.error("job %s (%s): %s", job.id, job.kind, error)
        work.update_job(connection, job.id, now_ns(), state="failed", error=error)
        return True

    def _enqueue(self, job: work.JobRow) -> None:
        with self._lock:
            self._waiting += 1
        # one of a kind that this version does not know fails wherever it is taken up
        self._queues.get(job.kind, next(iter(self._queues.values()))).put(job.id)

    def _run(self, waiting: queue.Queue[str | None]) -> None:
        while not self._stopping.is_set():
            job_id = waiting.get()
            if job_id is None:
                return
            try:
                self._work(job_id)
            except Exception:  # the thread must outlive a store that does not answer
                log.exception("job %s could not be begun; it is tried again", job_id)
                self._stopping.wait(RETRY_SECONDS)
                with self._lock:
                    self._waiting += 1
                waiting.put(job_id)
            finally:
                with self._lock:
                    self._waiting -= 1

    def _work(self, job_id: str) -> None:
        with self._store.write() as connection:
            job = work.get_job(connection, job_id)
            if job is None or job.state not in work.UNFINISHED:  # cancelled while it waited
                return
            work.update_job(connection, job_id, now_ns(), state="running", attempts=job.attempts + 1)
        if self._waits is not None and not job.attempts:
            self._waits.of(f"{job.kind} jobs")(max(0.0, (now_ns() - job.created_ns) / NANOSECONDS))
        kind = self._kinds.get(job.kind)
        progress = Progress(lambda share: self._note(job_id, share), self._stopping, kind.seconds if kind else 0.0)
        self._current[job_id] = progress
        started = time.monotonic()
        try:
            values = self._outcome(kind, job, progress)
        finally:
            del self._current[job_id]
        self._finish(job_id, values)
        if values["state"] == "queued":
            self._enqueue(job)
        if self._waits is not None:
            self._waits.job(job.kind, values["state"], time.monotonic() - started)
        log.info(
            "job ended",
            extra={"job": job_id, "kind": job.kind, "state": values["state"], "seconds": time.monotonic() - started},
        )

    def _outcome(self, kind: Kind | None, job: work.JobRow, progress: Progress) -> dict[str, Any]:
        try:
            if kind is None:
                raise UserError(f"jobs of kind {job.kind!r} are not known to this version")
            run = kind.run
            result = progress.retry(lambda: run(job, progress))
            return {"state": "done", "progress": 1.0, "result": result, "attempts": job.attempts}
        except ServiceStopped:
            return {"state": "queued", "attempts": job.attempts}  # an end in good order is no attempt
        except Cancelled:
            return {"state": "failed", "attempts": job.attempts}
        except WorkerKilled as error:
            attempts = job.attempts + 1
            if attempts < MOST_ATTEMPTS:
                log.error("job %s (%s): %s; it is tried once more", job.id, job.kind, error)
                return {"state": "queued", "attempts": attempts}
            log.error("job %s (%s): %s, %d times", job.id, job.kind, error, attempts)
            return {"state": "failed", "error": f"{error}, {attempts} times"[:500], "attempts": attempts}
        except UserError as error:
            return {"state": "failed", "error": str(error)[:500], "attempts": job.attempts}
        except Exception:
            if self._stopping.is_set():  # whatever it was, it came of stopping
                return {"state": "queued", "attempts": job.attempts}
            log.exception("job %s failed", job.id)
            return {"state": "failed", "error": WORST_MESSAGE, "attempts": job.attempts}

    def _finish(self, job_id: str, values: dict[str, Any]) -> None:
        """Write down what became of a job, as often as it takes."""
        while True:
            try:
                with self._store.write() as connection:
                    job = work.get_job(connection, job_id)
                    if job is not None and job.state in work.UNFINISHED:  # else it was cancelled meanwhile
                        work.update_job(connection, job_id, now_ns(), **values)
                return
            except (SQLAlchemyError, OSError) as error:
                log.error("the end of job %s cannot be stored yet: %s", job_id, first_line(error))
                if self._stopping.wait(RETRY_SECONDS):
                    return  # it is done again at the next start

    def _note(self, job_id: str, share: float) -> None:
        try:
            with self._store.write() as connection:
                work.update_job(connection, job_id, now_ns(), progress=share)
        except (SQLAlchemyError, OSError) as error:
            log.warning("the progress of job %s cannot be stored: %s", job_id, first_line(error))
