"""What waits on board to be sent: an SQLite file of bounded size, oldest out first when it is full.

A message is in the file before it counts as made, together with the state of the tracker after it: a vehicle that loses
power goes on where it stopped.  It leaves the file when the server has said that it is stored.
"""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sprung.service.errors import UserError

Kind = Literal["estimates", "recording"]
TABLES = """
CREATE TABLE IF NOT EXISTS entries (
  id INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL, name TEXT NOT NULL, body BLOB NOT NULL,
  bytes INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


@dataclass(frozen=True, slots=True)
class SpoolEntry:
    """Something to send."""

    id: int
    kind: Kind
    name: str  # of a recording's file
    body: bytes


class Spool:
    """Safe to share between threads.  Raises UserError where the file cannot be used, later OSError while it cannot."""

    def __init__(self, path: Path, limit_bytes: int) -> None:
        """limit_bytes: of all bodies; raw recordings go before estimates when more comes."""
        self._limit = limit_bytes
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._file.execute("PRAGMA journal_mode = WAL")
            self._file.execute("PRAGMA synchronous = FULL")
            self._file.executescript(TABLES)
        except (sqlite3.Error, OSError) as error:
            raise UserError(f"{path}: cannot hold messages to be sent ({error})") from error

    def add(self, kind: Kind, body: bytes, name: str = "", **facts: Any) -> int:
        """Keep something to send, and facts with it, all or nothing; how many older entries made room for it."""
        with self._transaction() as file:
            self._set(file, facts)
            file.execute(
                "INSERT INTO entries (kind, name, body, bytes) VALUES (?, ?, ?, ?)", (kind, name, body, len(body))
            )
            return self._make_room(file)

    def first(self) -> SpoolEntry | None:
        """What to send next: estimates before recordings, each oldest first."""
        with self._lock, _as_os_error():
            row = self._file.execute("SELECT id, kind, name, body FROM entries ORDER BY kind, id LIMIT 1").fetchone()
        return None if row is None else SpoolEntry(*row)

    def done(self, entry: SpoolEntry) -> None:
        """It was stored elsewhere."""
        with self._transaction() as file:
            file.execute("DELETE FROM entries WHERE id = ?", (entry.id,))

    def note(self, **facts: Any) -> None:
        """Keep facts alone."""
        with self._transaction() as file:
            self._set(file, facts)

    def fact(self, name: str) -> Any:
        """A fact as it was kept last, or None."""
        with self._lock, _as_os_error():
            row = self._file.execute("SELECT value FROM facts WHERE name = ?", (name,)).fetchone()
        return None if row is None else json.loads(row[0])

    @property
    def waiting(self) -> tuple[int, int]:
        """Entries and their bytes."""
        with self._lock, _as_os_error():
            count, size = self._file.execute("SELECT count(*), coalesce(sum(bytes), 0) FROM entries").fetchone()
        return int(count), int(size)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock, _as_os_error():
            self._file.execute("BEGIN IMMEDIATE")
            try:
                yield self._file
                self._file.execute("COMMIT")
            except BaseException:
                if self._file.in_transaction:  # SQLite ends some by itself, of a disk that is full for instance
                    self._file.execute("ROLLBACK")
                raise

    @staticmethod
    def _set(file: sqlite3.Connection, facts: dict[str, Any]) -> None:
        rows = [(name, json.dumps(value)) for name, value in facts.items()]
        file.executemany("INSERT INTO facts VALUES (?, ?) ON CONFLICT DO UPDATE SET value = excluded.value", rows)

    def _make_room(self, file: sqlite3.Connection) -> int:
        """Drop recordings, then estimates, the oldest first, until the rest is within the limit."""
        dropped = 0
        while True:
            (size,) = file.execute("SELECT coalesce(sum(bytes), 0) FROM entries").fetchone()
            if size <= self._limit:
                return dropped
            file.execute("DELETE FROM entries WHERE id = (SELECT id FROM entries ORDER BY kind DESC, id LIMIT 1)")
            dropped += 1


@contextmanager
def _as_os_error() -> Iterator[None]:
    """What the file refuses is told as of any other file: whoever waits for a disk tries again."""
    try:
        yield
    except sqlite3.OperationalError as error:
        raise OSError(f"messages cannot be kept: {error}") from error
