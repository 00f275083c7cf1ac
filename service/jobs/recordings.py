"""Uploaded recordings as jobs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sprung.replay import UnreadableRecording
from sprung.service.errors import UserError
from sprung.service.jobs.queue import Progress
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.processes.worker import ProcessLimits, WorkerKilled
from sprung.service.settings import Settings
from sprung.service.sources.feed import FeedResult, OnTally, feed_file
from sprung.service.sources.reading import SLOWEST_BYTES_PER_SECOND
from sprung.service.store import Store, fleet, work
from sprung.service.store.work import JobRow
from sprung.service.times import now_ns


class RecordingJobs:
    """Runs jobs of kind `recording`: a file from the upload folder, read in a process of its own, into the pipeline."""

    def __init__(self, settings: Settings, pipeline: Pipeline, counter: Callable[[], OnTally]) -> None:
        """counter: makes a callback that counts the messages of one recording."""
        self._settings = settings
        self._pipeline = pipeline
        self._counter = counter

    def run(self, job: JobRow, progress: Progress) -> dict[str, Any]:
        """Returns the summary of what was read."""
        path, row = stored_file(self._settings, self._pipeline.store, job)

        def on_batch(_batch: Batch) -> None:
            progress.step(0.0)  # the length of a recording is known only at its end

        try:
            fed = feed_file(
                self._pipeline,
                path,
                vehicle=job.vehicle_id,
                file_name=row.name,
                recording_id=row.id,
                batch_windows=self._settings.batch_windows,
                limits=reading_limits(self._settings, path),
                on_batch=on_batch,
                on_tally=self._counter(),
                check=progress.check,
                start=row.began_ns,
                retrying=True,
            )
        except (UnreadableRecording, UserError) as error:
            told = str(error).replace(str(path), row.name)
            raise (WorkerKilled if isinstance(error, WorkerKilled) else UserError)(told) from error
        progress.retry(lambda: finish_row(self._pipeline.store, row, fed))
        return {"recording": row.id} | fed.summary()


def reading_limits(settings: Settings, path: Path) -> ProcessLimits:
    """What reading a recording of a stranger may use."""
    return ProcessLimits(
        settings.reading_silence_seconds,
        settings.recording_seconds,
        settings.worker_memory_bytes,
        60 + path.stat().st_size // SLOWEST_BYTES_PER_SECOND,
    )


def stored_file(settings: Settings, store: Store, job: JobRow) -> tuple[Path, work.RecordingRow]:
    """The file of a job's recording; raises UserError when it is no longer kept."""
    with store.read() as connection:
        row = work.get_recording(connection, job.recording_id or "")
    path = None if row is None or row.file is None else settings.uploads / row.file
    if row is None or path is None or not path.is_file():
        raise UserError("the recording's file is no longer kept; upload it again")
    return path, row


def file_row(path: Path, began: int | None = None) -> work.RecordingRow:
    """The store's row of a file on this machine; began: ns since 1970, as the user says."""
    return work.RecordingRow(
        work.new_id(), None, path.name[:255], "file", None, path.stat().st_size, None, now_ns(), None, began
    )


def add_row(store: Store, row: work.RecordingRow) -> None:
    """Write down that a file is going to be read."""
    with store.write() as connection:
        work.add_recording(connection, row)


def finish_row(store: Store, row: work.RecordingRow, fed: FeedResult) -> None:
    """Write down what reading the file came to."""
    with store.write() as connection:
        fleet.ensure_vehicle(connection, fed.vehicle, now_ns())
        work.finish_recording(connection, row.id, fed.vehicle, fed.summary(), now_ns())
