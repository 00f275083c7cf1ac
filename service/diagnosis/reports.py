"""Mismatch reports: asked for by a user, or started when a vehicle's windows have stopped fitting for long enough."""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sprung.model.system import MANCHESTER
from sprung.model.text import first_line
from sprung.service.diagnosis.excerpts import kept_excerpt
from sprung.service.diagnosis.task import DiagnosisRequest, DiagnosisResult, Stage
from sprung.service.diagnosis.worker import run
from sprung.service.durable import sync_folder, sync_tree
from sprung.service.errors import Busy, UserError
from sprung.service.jobs.queue import Jobs, Noted, Progress
from sprung.service.jobs.recordings import stored_file
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.monitoring.ring import Excerpt, Rings
from sprung.service.processes.worker import ProcessLimits, Task, Worker
from sprung.service.settings import Settings
from sprung.service.store import Store, fleet, vehicle_models, work
from sprung.service.store.work import JobRow, RecordingRow, ReportRow
from sprung.service.times import NANOSECONDS, now_ns

log = logging.getLogger("sprung.diagnosis")
SEARCH = 0.6  # share of a diagnosis's time; the rest is for the running fits, the last fit and the plots


class Diagnoses:
    """Accepts diagnoses."""

    def __init__(self, settings: Settings, store: Store, rings: Rings, jobs: Jobs) -> None:
        self._settings = settings
        self._store = store
        self._rings = rings
        self._jobs = jobs
        self._lock = threading.Lock()
        self._started: dict[str, str] = {}  # vehicle -> the last job that was started from here
        self._next: dict[str, int] = {}  # vehicle -> time of a window before which none is started again

    def on_batch(self, batch: Batch) -> None:
        """Keep the samples; start a diagnosis when the vehicle's windows have not fitted for long enough."""
        urgent = batch.state.misfit_since is not None or bool(batch.state.active)
        self._rings.add(batch.vehicle, batch.fresh, urgent)
        since, now = batch.state.misfit_since, batch.state.time
        if not batch.fresh or since is None or now is None:
            return
        if (now - since) / NANOSECONDS < self._settings.misfit_seconds:
            return
        with self._lock:
            if now < self._next.get(batch.vehicle, 0):
                return
            self._next[batch.vehicle] = now + round(self._settings.misfit_pause_seconds * NANOSECONDS)
            before = self._started.get(batch.vehicle)
        job = None
        try:
            job = None if self._runs(before) else self.from_excerpt(batch.vehicle)
        except (Busy, UserError):
            pass
        except (OSError, SQLAlchemyError) as error:  # the windows are stored, whatever comes of this
            log.warning("a diagnosis of %s cannot be begun yet: %s", batch.vehicle, first_line(error))
        with self._lock:
            if job is None:
                self._next.pop(batch.vehicle, None)  # tried again with the next window
            else:
                self._started[batch.vehicle] = job.id

    def excerpt(self, vehicle: str) -> Excerpt | None:
        """The samples that are held of a vehicle."""
        return self._rings.excerpt(vehicle)

    def from_excerpt(self, vehicle: str, noted: Noted = lambda connection, job: None) -> JobRow:
        """Accept a diagnosis of a vehicle's last minute.  Raises UserError when nothing is held of it, or Busy."""
        excerpt = self._rings.excerpt(vehicle)
        if excerpt is None:
            raise UserError(f"no recent samples of {vehicle} are held; upload a recording instead")
        self._jobs.reserve()
        label = f"last {len(excerpt.values) / excerpt.sample_rate:.0f} s of {vehicle}"
        with kept_excerpt(self._settings.uploads, excerpt) as path:
            size = path.stat().st_size
            row = RecordingRow(work.new_id(), vehicle, label, "excerpt", path.name, size, None, now_ns(), None)
            return self._jobs.submit("diagnosis", row, vehicle, noted)

    def from_recording(
        self, row: RecordingRow, vehicle: str | None, noted: Noted = lambda connection, job: None
    ) -> JobRow:
        """Accept a diagnosis of a recording in the upload folder."""
        return self._jobs.submit("diagnosis", row, vehicle or row.vehicle_id, noted)

    def _runs(self, job_id: str | None) -> bool:
        if job_id is None:
            return False
        with self._store.read() as connection:
            job = work.get_job(connection, job_id)
        return job is not None and job.state in work.UNFINISHED


OnReport = Callable[[Connection, str | None, str, dict[str, Any]], None]


class DiagnosisJobs:
    """Runs jobs of kind `diagnosis`, each in a process of its own, and keeps their reports."""

    def __init__(
        self,
        settings: Settings,
        pipeline: Pipeline,
        task: Task[DiagnosisRequest, Stage, DiagnosisResult] = run,
        on_report: OnReport = lambda connection, vehicle, report_id, report: None,
    ) -> None:
        """on_report: called with a new report inside the transaction that stores it."""
        self._settings = settings
        self._engines = pipeline.engines
        self._store = pipeline.store
        self.task = task
        self._on_report = on_report

    def run(self, job: JobRow, progress: Progress) -> dict[str, Any]:
        """Handler of jobs of kind `diagnosis`; returns the report's id and verdict."""
        report_id = job.id  # one report a job
        with self._store.read() as connection:
            kept = work.get_report(connection, report_id)
        if kept is not None:  # the service was killed before the job was noted as done
            return {"report": report_id, "verdict": kept.verdict}
        path, row = stored_file(self._settings, self._store, job)
        vehicle = job.vehicle_id
        with self._store.read() as connection:
            served = self._engines.shared if vehicle is None else self._engines.of(connection, vehicle)
            text = None if vehicle is None else vehicle_models.text_of(connection, vehicle, served.version)
        found = self._diagnose(path, row, report_id, progress, served, text)

        def keep() -> None:
            with self._store.write() as connection:
                if vehicle is not None:
                    fleet.ensure_vehicle(connection, vehicle, now_ns())
                if work.get_report(connection, report_id) is None:
                    report = ReportRow(report_id, vehicle, row.id, found.verdict, found.report, now_ns())
                    work.add_report(connection, report)
                    self._on_report(connection, vehicle, report_id, found.report)
                if vehicle is not None and row.source == "excerpt":
                    fleet.attach_report(connection, vehicle, served.model_id, report_id)

        progress.retry(keep)  # rather than search once more
        return {"report": report_id, "verdict": found.verdict}

    def _diagnose(
        self, path: Path, row: RecordingRow, report_id: str, progress: Progress, served: ServedModel, text: str | None
    ) -> DiagnosisResult:
        """Written beside, by one process only, and moved to its place when it is whole."""
        final = self._settings.reports / report_id
        part = final.with_name(f"{report_id}.{os.getpid()}.part")
        shutil.rmtree(part, ignore_errors=True)
        engine, seconds = served.engine, self._settings.diagnosis_seconds
        request = DiagnosisRequest(
            path, row.name, engine.system, engine.dbc, part, text or self._shared_text(), SEARCH * seconds, row.began_ns
        )
        worker = Worker(
            self.task, request, ProcessLimits(seconds, seconds, self._settings.worker_memory_bytes), "the diagnosis"
        )
        try:
            for stage in worker.messages(progress.check):
                progress.step(0.99 * stage.share)
            shutil.rmtree(final, ignore_errors=True)
            sync_tree(part)  # the report is announced by the store: a power cut must not leave it without its page
            part.rename(final)
            sync_folder(final.parent)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return worker.result

    def _shared_text(self) -> str | None:
        source = self._settings.system or MANCHESTER
        try:
            return source.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            log.warning("%s: findings cannot be written into a copy of it: %s", source, error)
            return None
