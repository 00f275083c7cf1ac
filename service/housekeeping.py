"""Every hour: forget what is older than the settings keep."""

from __future__ import annotations

import logging
import threading

from sqlalchemy.exc import SQLAlchemyError

from sprung.service.settings import Settings
from sprung.service.store import Store, retention
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
