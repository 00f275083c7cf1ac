"""Hourly deletion of data that are older than the settings keep."""

from __future__ import annotations

import json
import logging
import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from sqlalchemy import ColumnElement, Connection

from sprung.service.settings import Settings
from sprung.service.store import Store, outbox, retention, work
from sprung.service.store.archive import open_archive
from sprung.service.times import NANOSECONDS, now_ns

log = logging.getLogger("sprung.housekeeping")
PERIOD_SECONDS = 3600.0
DAY = 86_400 * NANOSECONDS
DELIVERIES_KEPT = 30 * DAY  # notifications that have arrived, or were given up
LONGEST_PAUSE = DAY  # by which a pause of the service ages stored data


@dataclass(frozen=True, slots=True)
class _Mark:
    """What is written down of the clock, ns."""

    time_ns: int  # where it stands
    wall_ns: int  # the host's clock then
    owed_ns: int = 0  # by which the host's clock went back; it does not count when it is made up for


class RetentionClock:
    """Time by which things age: it goes with the host's clock, but takes no leap.

    While a process runs it advances as the monotonic clock does, however the host's clock is set meanwhile; over a
    pause it advances by what the host's clock did since it was last written down, a day at the most.  A clock that is
    forty days ahead after a rollover, or years because a battery was empty, makes nothing old, however often the
    service starts; a train that stood for months loses its data some days later than it could.  Where the host's clock
    went back, that much (a day at the most) of what it goes on later does not count: one that is now right and now
    wrong does not add up either.
    """

    def __init__(
        self,
        path: Path,
        before: Callable[[], int | None],
        wall: Callable[[], int] = now_ns,
        monotonic: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """before: where the clock stood as far as anybody knows, when its file is not there."""
        self._path = path
        self._before = before
        self._wall = wall
        self._monotonic = monotonic
        self._last: tuple[int, _Mark] | None = None  # monotonic and what was known then
        self._lock = threading.Lock()

    def now(self) -> int:
        """ns since epoch; written down, so that the next process goes on from there."""
        with self._lock:
            mark = self._advanced()
            try:
                self._keep(mark)
            except OSError as error:  # a full disk is no reason not to delete what is old
                log.error("the clock of retention cannot be written down: %s", error)
            return mark.time_ns

    def read(self) -> int:
        """ns since epoch; nothing is written down."""
        with self._lock:
            return self._advanced().time_ns

    def _advanced(self) -> _Mark:
        wall, monotonic = self._wall(), self._monotonic()
        if self._last is not None:
            since, mark = self._last
            mark = _Mark(mark.time_ns + (monotonic - since), wall, mark.owed_ns)
        else:
            mark = self._after_a_pause(wall)
        self._last = (monotonic, mark)
        return mark

    def _keep(self, mark: _Mark) -> None:
        part = self._path.with_suffix(".part")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(asdict(mark)))
        part.replace(self._path)

    def _after_a_pause(self, wall: int) -> _Mark:
        kept = self._kept()
        if kept is None:
            before = self._before()
            kept = _Mark(wall, wall) if before is None else _Mark(before, before)
        gone = min(max(wall - kept.wall_ns, -LONGEST_PAUSE), LONGEST_PAUSE) - kept.owed_ns
        return _Mark(kept.time_ns + max(gone, 0), wall, min(max(-gone, 0), LONGEST_PAUSE))

    def _kept(self) -> _Mark | None:
        try:
            found = json.loads(self._path.read_text())
            time_ns = int(found["time_ns"])
            return _Mark(time_ns, int(found.get("wall_ns", time_ns)), int(found.get("owed_ns", 0)))
        except (OSError, ValueError, KeyError, TypeError):
            return None


class Housekeeping:
    """A thread that applies the retention settings."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self.clock = RetentionClock(settings.data_dir / "retention.json", self._newest)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-housekeeping", daemon=True)

    def start(self) -> None:
        """Begin, with a first round at once."""
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def clear_leftovers(self) -> list[str]:
        """Delete what a killed process left incomplete, or the store does not know, before anything is accepted.

        A store that knows no file of a folder may be a new one beside the files of another: then only what is
        incomplete goes.  Returns the names.
        """
        with self._store.read() as connection:
            kept = {self._settings.uploads: work.stored_files(connection)}
            kept[self._settings.reports] = work.kept_reports(connection)
        left = [
            path
            for folder, names in kept.items()
            for path in _entries(folder)
            if path.name not in names and (names or path.name.endswith(".part"))
        ]
        for path in left:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        if left:
            log.warning("%d files that a killed process left behind are deleted", len(left))
        return [path.name for path in left]

    def once(self, now: int, keep: bool = True) -> retention.RetentionResult:
        """One round, as if it were `now`, ns since epoch; keep: False only lists what would be deleted."""
        settings = self._settings
        limits = retention.RetentionLimits(
            now - round(settings.retention_windows_days * DAY),
            now - round(settings.retention_minutes_days * DAY),
            now - round(settings.retention_uploads_days * DAY),
            settings.retention_store_bytes,
            round(0.8 * settings.max_uploads_bytes),  # so that the next upload finds room
        )
        archive = open_archive(settings.archive) if keep else None

        def archived(connection: Connection, *which: ColumnElement[bool]) -> None:
            if archive is not None:
                archive.keep(connection, now, *which)

        with self._store.write() as connection:
            forgotten = retention.forget(connection, limits, archived)
            newest = [row for *_, row in outbox.newest_of_sources(connection)]
            outbox.forget_deliveries(connection, now - DELIVERIES_KEPT, newest)
            if not keep:
                connection.rollback()
                return forgotten
        if (beyond := forgotten.too_many_bytes) > 0:
            log.warning(
                "the store is %.1f MB beyond SPRUNG_RETENTION_STORE_BYTES: no more windows can go", beyond / 1e6
            )
        for name in forgotten.upload_files:
            (settings.uploads / name).unlink(missing_ok=True)
        return forgotten

    def _newest(self) -> int | None:
        """When the last window was stored: a store that comes without its clock is not older than that."""
        with self._store.read() as connection:
            return retention.newest(connection)

    def _run(self) -> None:
        while True:
            try:
                self.once(self.clock.now())
            except Exception:  # it may be over in an hour, and nothing else deletes old data
                log.exception("housekeeping failed; it tries again in an hour")
            if self._stopping.wait(PERIOD_SECONDS):
                return


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []
