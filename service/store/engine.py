"""Opening a store: the engine, SQLite's pragmas, and transactions.

SQLite has one writer, so a process lets one transaction write at a time.  On PostgreSQL many write at once, and who
reads a vehicle's tracker to write it holds the vehicle's row (`fleet.hold_vehicle`).
"""

from __future__ import annotations

import errno
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from pydantic_core import to_json
from sqlalchemy import URL, Connection, Engine, Table, create_engine, event, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import ExceptionContext, make_url
from sqlalchemy.exc import ArgumentError, DatabaseError, NoSuchModuleError

from sprung.model.text import first_line
from sprung.service.errors import UserError
from sprung.service.store.write_lock import LONGEST_WAIT, WriteLock

BUSY_MILLISECONDS = 15_000  # a second process waits this long for the first one's transaction
PROBE_SECONDS = 2.0
LAST_SECONDS = 0.2  # for which a transaction waits where the process should have ended
KEPT_READERS, MOST_READERS = 8, 32  # connections to SQLite that stay open; more while as many requests read at once
MOST_WRITERS = 10  # transactions of one process at once on PostgreSQL; others wait
LITTLE_BYTES = 4_000_000  # free on a disk: SQLite's write-ahead log grows to this
STATEMENT_MILLISECONDS = 60_000  # a statement that takes longer is given up: its caller tries again
UPSERT_DIALECTS = ("sqlite", "postgresql")


class StoreFile:
    """The file of an SQLite store, which may be deleted, moved or replaced while it is open.

    SQLite would go on with the one that it has opened, and what is written there is gone with the process; and begin a
    new one for the next connection.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._opened: tuple[int, int] | None = None  # device and inode

    def opened(self, _connection: Any, _record: Any) -> None:
        """It is that one."""
        if self._opened is None:
            self._opened = self._now()

    def check(self, *_: Any) -> None:
        """Raises OSError where it is no longer in its place."""
        if self._opened is not None and self._now() != self._opened:
            told = f"{self._path} is gone, or another file is in its place; put it back, or start the service again"
            raise OSError(errno.EIO, told)

    def _now(self) -> tuple[int, int] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return found.st_dev, found.st_ino


class Store:
    """Transactions on one database.  Safe to share between threads."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._file = None if self.folder is None else StoreFile(Path(engine.url.database or "").expanduser())
        if self._file is not None:
            event.listen(engine, "do_connect", self._file.check)
            event.listen(engine, "connect", self._file.opened)
        event.listen(engine, "handle_error", _name_store)
        self.many_writers = engine.dialect.name == "postgresql"
        # one writer a process where the database has one anyway: waiting is fair here
        self.write_lock = WriteLock(MOST_WRITERS if self.many_writers else 1)
        self._leave = math.inf  # monotonic s, by when nothing waits to write any more
        self.on_wait: Callable[[float], None] = lambda seconds: None  # takes each transaction's wait to write
        self.months: set[str] = set()  # partitions that are known to be there (`partitions.prepare`)

    @property
    def folder(self) -> Path | None:
        """Where an SQLite store lies; None for one on a server."""
        return _folder(self.engine.url)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A consistent snapshot."""
        with self.engine.connect() as connection:
            if self.many_writers:  # SQLite's readers have one by themselves
                connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin():
                yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """One transaction, committed at the end, rolled back when anything raises.

        Raises SQLAlchemyError where its turn does not come, or the database does not take it; OSError where its file
        is not in its place.
        """
        asked = time.perf_counter()
        with self.write_lock.held(self._patience(LONGEST_WAIT)), self.engine.connect() as connection:
            self._check_file()
            if self._leave < math.inf:
                self._wait_for_others(connection, self._patience(BUSY_MILLISECONDS / 1000))
            connection.execution_options(sprung_write=True)
            with connection.begin():
                self.on_wait(time.perf_counter() - asked)
                yield connection
            self._check_file()  # nothing is acknowledged that was written to one that is gone

    def probe(self) -> None:
        """Raises SQLAlchemyError, or OSError, when nothing can be written now; changes nothing."""
        self._check_file()
        with self.write_lock.held(PROBE_SECONDS), self.engine.connect() as connection:
            self._wait_for_others(connection, PROBE_SECONDS)
            try:
                connection.execution_options(sprung_write=True)
                with connection.begin() as transaction:
                    connection.execute(text("SELECT 1"))
                    transaction.rollback()
            finally:
                self._wait_for_others(connection, BUSY_MILLISECONDS / 1000)

    def leave_within(self, seconds: float) -> None:
        """The process ends: where another one holds the database, what is still to be written does not wait longer."""
        self._leave = min(self._leave, time.monotonic() + seconds)

    def _patience(self, seconds: float) -> float:
        """The seconds for which to wait, or as many as are left."""
        return min(seconds, max(LAST_SECONDS, self._leave - time.monotonic()))

    def _wait_for_others(self, connection: Connection, seconds: float) -> None:
        """How long other processes' transactions are waited for."""
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql(f"PRAGMA busy_timeout = {round(1000 * seconds)}")
            connection.rollback()

    def _check_file(self) -> None:
        if self._file is not None:
            self._file.check()

    def close(self) -> None:
        """Close every connection; SQLite then folds its write-ahead log into the file."""
        self.engine.dispose()


def open_store(url: str, migrated: bool = False, *, there: bool = False) -> Store:
    """The store at a SQLAlchemy URL (or the path of an SQLite file), migrated to the newest schema.

    migrated: whoever hands out the work has done that already; looking takes longer than many a piece of work.
    there: refuse an SQLite file that is not there, rather than begin one.
    Raises UserError when the URL is not one or the database cannot be opened.
    """
    if "://" not in url:
        url = f"sqlite:///{url}"
    shown = url
    try:
        parsed = make_url(url)
        shown = parsed.render_as_string(hide_password=True)
        if parsed.get_backend_name() not in UPSERT_DIALECTS:
            raise UserError(f"store {shown}: only {' and '.join(UPSERT_DIALECTS)} URLs are supported")
        if parsed.get_backend_name() == "sqlite":
            if there and parsed.database and not Path(parsed.database).exists():
                raise UserError(f"store {shown}: there is none; give the --data-dir or --store of the service")
            engine = _sqlite_engine(url, parsed.database)
        else:
            engine = _postgresql_engine(parsed)
        store = Store(engine)
        if not migrated:
            from sprung.service.store.migrating import migrate

            try:
                with store.write() as connection:
                    migrate(connection)
            except BaseException:
                store.close()
                raise
    except ModuleNotFoundError as error:
        raise UserError(f"store {shown}: {error.name} is missing; pip install 'sprung[fleet]'") from error
    except (ArgumentError, NoSuchModuleError) as error:
        raise UserError(f"store {shown}: not a usable database URL ({first_line(error)})") from error
    except (DatabaseError, OSError) as error:
        raise UserError(f"store {shown}: cannot be opened ({first_line(error)}{_full(parsed)})") from error
    return store


def insert_or_ignore(connection: Connection, table: Table, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows; one whose key is there already is left as it is."""
    if rows:
        connection.execute(_ignoring(connection.dialect.name, table), rows)


def upsert(connection: Connection, table: Table, rows: Sequence[dict[str, Any]], key: Sequence[str]) -> None:
    """Insert rows, or overwrite the columns outside `key` where the key is there already.

    All rows must give the same columns; columns that are not given keep their values.
    """
    if not rows:
        return
    connection.execute(_overwriting(connection.dialect.name, table, tuple(rows[0]), tuple(key)), rows)


_INSERTS: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}


@cache  # making a statement takes longer than sending it
def _ignoring(dialect: str, table: Table) -> Any:
    return _INSERTS[dialect](table).on_conflict_do_nothing()


@cache
def _overwriting(dialect: str, table: Table, names: tuple[str, ...], key: tuple[str, ...]) -> Any:
    statement = _INSERTS[dialect](table)
    changed = {name: statement.excluded[name] for name in names if name not in key}
    return statement.on_conflict_do_update(index_elements=list(key), set_=changed)


def _postgresql_engine(url: URL) -> Engine:
    if url.drivername == "postgresql":  # what that stands for differs between versions of SQLAlchemy
        url = url.set(drivername="postgresql+psycopg")
    options = f"-c statement_timeout={STATEMENT_MILLISECONDS} -c timezone=UTC"
    return create_engine(
        url,
        pool_size=MOST_WRITERS,
        max_overflow=2 * MOST_WRITERS,  # readers
        json_serializer=_json,
        pool_pre_ping=True,  # the server may have been started anew since a connection was used last
        connect_args={"options": options, "connect_timeout": 10},
    )


def _json(value: Any) -> str:
    """A tracker's state is 80 kB: `json.dumps` takes five times as long."""
    return to_json(value).decode()


def _folder(url: URL) -> Path | None:
    """Where the file of an SQLite database lies; None of one on a server."""
    return Path(url.database or "").expanduser().parent if url.get_backend_name() == "sqlite" else None


def _full(url: URL) -> str:
    """What SQLite does not say of a disk that has no room for its shared memory: "disk I/O error" is all that comes."""
    folder = _folder(url)
    if folder is None:
        return ""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        return ""
    return f"; {free / 1e6:.1f} MB are free on its disk" if free < LITTLE_BYTES else ""


def _sqlite_engine(url: str, database: str | None) -> Engine:
    if not database or database == ":memory:":
        raise UserError(f"store {url}: give a file, as in sqlite:////var/lib/sprung/sprung.db")
    Path(database).expanduser().parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(
        url,
        pool_size=KEPT_READERS,
        max_overflow=MOST_READERS,
        json_serializer=_json,
        connect_args={"timeout": BUSY_MILLISECONDS / 1000},
    )
    event.listen(engine, "connect", _on_sqlite_connect)
    event.listen(engine, "begin", _on_sqlite_begin)
    return engine


def _on_sqlite_connect(connection: Any, _record: Any) -> None:
    # the driver must not open transactions by itself: reads would not be snapshots, and a read that turns
    # into a write fails at once instead of waiting
    connection.isolation_level = None
    for pragma in (
        f"busy_timeout = {BUSY_MILLISECONDS}",
        "journal_mode = WAL",  # readers do not wait for the writer
        "synchronous = FULL",  # what was acknowledged survives a power cut, too; NORMAL would lose the last seconds
        "foreign_keys = ON",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _on_sqlite_begin(connection: Connection) -> None:
    writes = connection.get_execution_options().get("sprung_write", False)
    connection.execute(text("BEGIN IMMEDIATE" if writes else "BEGIN"))


def _name_store(context: ExceptionContext) -> None:
    """Let errors of the database say which one it is."""
    if context.sqlalchemy_exception is not None and context.engine is not None:
        context.sqlalchemy_exception.add_note(f"store {context.engine.url.render_as_string(hide_password=True)}")
