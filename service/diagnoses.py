"""Mismatch reports: asked for by a user, or started when a vehicle's windows have stopped fitting for long enough.

A diagnosis takes half a minute of both cores, so it runs in a process of its own (`sprung diagnose`, at low priority):
requests and live windows go on meanwhile, and a stop can interrupt it.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from sprung.replay.account import Account
from sprung.replay.record import Record
from sprung.service.engine import Engine
from sprung.service.errors import Busy, UserError
from sprung.service.jobs import Jobs, Progress, Stopped
from sprung.service.pipeline import Batch
from sprung.service.recordings import stored_file
from sprung.service.ring import Excerpt, Rings
from sprung.service.settings import Settings
from sprung.service.store import Store, fleet, work
from sprung.service.store.work import JobRow, RecordingRow, ReportRow
from sprung.service.times import NANOSECONDS, now_ns

POLL_SECONDS = 0.2
LONGEST_SECONDS = 600  # s a diagnosis may take


class Diagnoses:
    """Starts diagnoses and keeps their reports."""

    def __init__(self, settings: Settings, engine: Engine, store: Store, rings: Rings, model_id: int) -> None:
        self._settings = settings
        self._engine = engine
        self._store = store
        self._rings = rings
        self._model_id = model_id
        self._lock = threading.Lock()
        self._running: set[str] = set()  # vehicles with a diagnosis that was started from here
        self._next: dict[str, int] = {}  # vehicle -> time of a window before which none is started again
        self.jobs: Jobs | None = None

    def on_batch(self, batch: Batch) -> None:
        """Keep the samples; start a diagnosis when the vehicle's windows have not fitted for long enough."""
        self._rings.add(batch.vehicle, batch.fresh)
        since, now = batch.state.misfit_since, batch.state.time
        if not batch.fresh or since is None or now is None:
            return
        if (now - since) / NANOSECONDS < self._settings.misfit_seconds:
            return
        with self._lock:
            if batch.vehicle in self._running or now < self._next.get(batch.vehicle, 0):
                return
            self._running.add(batch.vehicle)
            self._next[batch.vehicle] = now + round(self._settings.misfit_pause_seconds * NANOSECONDS)
        try:
            self.from_excerpt(batch.vehicle)
        except (Busy, UserError):
            with self._lock:  # tried again with the next window
                self._running.discard(batch.vehicle)
                self._next.pop(batch.vehicle, None)

    def from_excerpt(self, vehicle: str) -> JobRow:
        """Accept a diagnosis of a vehicle's last minute.  Raises UserError when nothing is held of it, or Busy."""
        excerpt = self._rings.excerpt(vehicle)
        if excerpt is None:
            raise UserError(f"no recent samples of {vehicle} are held; upload a recording instead")
        self._jobs.reserve()
        name = f"{work.new_id()}.npz"
        save_excerpt(self._settings.uploads / name, excerpt)
        size = (self._settings.uploads / name).stat().st_size
        label = f"last {len(excerpt.values) / excerpt.sample_rate:.0f} s of {vehicle}"
        row = RecordingRow(work.new_id(), vehicle, label, "excerpt", name, size, None, now_ns(), None)
        return self._jobs.submit("diagnosis", row, vehicle)

    def from_recording(self, row: RecordingRow, vehicle: str | None) -> JobRow:
        """Accept a diagnosis of a recording in the upload folder."""
        return self._jobs.submit("diagnosis", row, vehicle or row.vehicle_id)

    def run(self, job: JobRow, progress: Progress) -> dict[str, Any]:
        """Handler of jobs of kind `diagnosis`; returns the report's id and verdict."""
        try:
            path, row = stored_file(self._settings, self._store, job)
            report_id = job.id  # one report a job: a job that is done again overwrites its own
            report = self._diagnose(path, row, self._settings.reports / report_id, progress)
            vehicle = job.vehicle_id
            with self._store.write() as connection:
                if vehicle is not None:
                    fleet.ensure_vehicle(connection, vehicle, now_ns())
                if work.get_report(connection, report_id) is None:
                    verdict = str(report["verdict"])
                    work.add_report(connection, ReportRow(report_id, vehicle, row.id, verdict, report, now_ns()))
                if vehicle is not None and row.source == "excerpt":
                    fleet.attach_report(connection, vehicle, self._model_id, report_id)
            return {"report": report_id, "verdict": report["verdict"]}
        finally:
            with self._lock:
                self._running.discard(job.vehicle_id or "")

    @property
    def _jobs(self) -> Jobs:
        if self.jobs is None:
            raise Busy("the service is starting")
        return self.jobs

    def _diagnose(self, path: Path, row: RecordingRow, out: Path, progress: Progress) -> dict[str, Any]:
        command = [sys.executable, "-m", "sprung", "diagnose", str(path), f"--name={row.name}"]
        command += ["--out", str(out), "--json"]
        if self._settings.system is not None:
            command += ["--system", str(self._settings.system)]
        if self._engine.dbc is not None:
            command += ["--dbc", str(self._engine.dbc)]
        gentle = ["nice", "-n", "10"] if shutil.which("nice") else []
        process = subprocess.Popen(
            gentle + command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL
        )
        output, errors = _wait(process, progress)
        if process.returncode not in (0, 1):
            line = errors.strip().splitlines()[-1:] or ["the diagnosis ended without an answer"]
            raise UserError(line[0].removeprefix("sprung: ").replace(str(path), row.name))
        report: dict[str, Any] = json.loads(output)
        return report


def save_excerpt(path: Path, excerpt: Excerpt) -> None:
    """Write samples as an .npz that `load_excerpt` reads."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, start=excerpt.start, sample_rate=excerpt.sample_rate, values=excerpt.values)


def load_excerpt(path: Path) -> Record:
    """Read what `save_excerpt` wrote."""
    with np.load(path, allow_pickle=False) as data:
        start, rate, values = int(data["start"]), float(data["sample_rate"]), data["values"]
    missing = np.isnan(values)
    lost = int(missing[:, ~missing.all(axis=0)].sum())
    return Record(start, rate, values, lost, None, (), Account())


def _wait(process: subprocess.Popen[bytes], progress: Progress) -> tuple[str, str]:
    """Output and errors; ends the process when the service stops or the time is over."""
    deadline = time.monotonic() + LONGEST_SECONDS
    while True:
        try:
            output, errors = process.communicate(timeout=POLL_SECONDS)
            return output.decode(), errors.decode()
        except subprocess.TimeoutExpired:
            if not progress.stopping and time.monotonic() < deadline:
                continue
            process.kill()
            process.communicate()
            if progress.stopping:
                raise Stopped from None
            raise UserError(f"the diagnosis took longer than {LONGEST_SECONDS} s") from None
