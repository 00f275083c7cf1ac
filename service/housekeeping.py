"""Every hour: forget what is older than the settings keep."""

from __future__ import annotations

import logging
import shutil
import threading
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from sprung.service.settings import Settings
from sprung.service.store import Store, retention, work
from sprung.service.times import NANOSECONDS, now_ns

log = logging.getLogger("sprung.housekeeping")
PERIOD_SECONDS = 3600.0
DAY = 86_400 * NANOSECONDS


class Housekeeping:
    """A thread that applies the retention settings."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
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
        """Delete what a process that died left half written; call it before anything is accepted.  The names."""
        with self._store.read() as connection:
            kept = work.stored_files(connection)
        left = [path for path in _entries(self._settings.uploads) if path.name not in kept]
        left += [path for path in _entries(self._settings.reports) if path.name.endswith(".part")]
        for path in left:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        if left:
            log.warning("%d files that were left half written are deleted", len(left))
        return [path.name for path in left]

    def once(self, now: int) -> retention.Forgotten:
        """One round, as if it were `now`, ns since epoch."""
        settings = self._settings
        with self._store.write() as connection:
            forgotten = retention.forget(
                connection,
                now - round(settings.retention_windows_days * DAY),
                now - round(settings.retention_minutes_days * DAY),
                now - round(settings.retention_uploads_days * DAY),
            )
        for name in forgotten.upload_files:
            (settings.uploads / name).unlink(missing_ok=True)
        return forgotten

    def _run(self) -> None:
        while True:
            try:
                self.once(now_ns())
            except (SQLAlchemyError, OSError):
                log.exception("housekeeping failed; it tries again in an hour")
            if self._stopping.wait(PERIOD_SECONDS):
                return


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []
