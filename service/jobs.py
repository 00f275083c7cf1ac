"""Work that goes on after its request was answered: one thread, a bounded queue, everything in the store.

What was accepted survives: a job that a stop interrupts is queued again and goes on at the next start (windows are
stored once, so doing a part twice changes nothing).
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from sprung.service.errors import Busy, UserError
from sprung.service.store import Store, work
from sprung.service.times import now_ns

log = logging.getLogger("sprung.jobs")
WORST_MESSAGE = "an unexpected error; the service's log has the details"


class Stopped(Exception):
    """Raised inside a handler when the service stops."""


class Progress:
    """What a handler reports to; `step` also tells it to stop."""

    def __init__(self, store: Store, job_id: str, stopping: threading.Event) -> None:
        self._store = store
        self._job_id = job_id
        self._stopping = stopping
        self._shown = 0.0

    @property
    def stopping(self) -> bool:
        """Whether the service is going down."""
        return self._stopping.is_set()

    def step(self, share: float) -> None:
        """`share` of the work is done, 0..1.  Raises Stopped when the service stops."""
        if self.stopping:
            raise Stopped
        if share >= self._shown + 0.01:
            self._shown = share
            with self._store.write() as connection:
                work.update_job(connection, self._job_id, now_ns(), progress=min(share, 1.0))


Handler = Callable[[work.JobRow, Progress], dict[str, Any]]


class Jobs:
    """Accepts jobs and works through them in order.

    handlers: by kind; each returns the job's result, or raises UserError with a line for the user.
    """

    def __init__(self, store: Store, handlers: Mapping[str, Handler], queue_size: int) -> None:
        self._store = store
        self._handlers = handlers
        self._limit = queue_size
        self._queue: queue.Queue[str | None] = queue.Queue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-jobs", daemon=True)

    def start(self) -> None:
        """Take up what a previous process left, then wait for more."""
        with self._store.read() as connection:
            left = work.unfinished_jobs(connection)
        for job in left:
            self._enqueue(job.id)
        self._thread.start()

    def reserve(self) -> None:
        """Raise Busy when no further job can be accepted now."""
        if self._waiting >= self._limit or self._stopping.is_set():
            raise Busy(f"{self._waiting} jobs are waiting already; try again later")

    def submit(self, kind: str, recording: work.RecordingRow | None = None, vehicle: str | None = None) -> work.JobRow:
        """Accept a job: it is in the store when this returns.  Raises Busy when too many wait."""
        self.reserve()
        now = now_ns()
        recording_id = None if recording is None else recording.id
        job = work.JobRow(work.new_id(), kind, "queued", recording_id, vehicle, 0.0, None, None, now, now)
        with self._store.write() as connection:
            if recording is not None and work.get_recording(connection, recording.id) is None:
                work.add_recording(connection, recording)
            work.add_job(connection, job)
        self._enqueue(job.id)
        return job

    def close(self) -> None:
        """Interrupt the running job; it and the waiting ones stay queued in the store."""
        self._stopping.set()
        self._queue.put(None)
        if self._thread.is_alive():
            self._thread.join()

    def _enqueue(self, job_id: str) -> None:
        with self._lock:
            self._waiting += 1
        self._queue.put(job_id)

    def _run(self) -> None:
        while not self._stopping.is_set():
            job_id = self._queue.get()
            if job_id is None:
                return
            try:
                self._work(job_id)
            finally:
                with self._lock:
                    self._waiting -= 1

    def _work(self, job_id: str) -> None:
        with self._store.write() as connection:
            work.update_job(connection, job_id, now_ns(), state="running")
            job = work.get_job(connection, job_id)
        if job is None:
            return
        values: dict[str, Any]
        try:
            result = self._handlers[job.kind](job, Progress(self._store, job_id, self._stopping))
            values = {"state": "done", "progress": 1.0, "result": result}
        except Stopped:
            values = {"state": "queued"}
        except UserError as error:
            values = {"state": "failed", "error": str(error)[:500]}
        except Exception:
            log.exception("job %s failed", job_id)
            values = {"state": "failed", "error": WORST_MESSAGE}
        with self._store.write() as connection:
            work.update_job(connection, job_id, now_ns(), **values)
