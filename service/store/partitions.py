"""Windows by month on PostgreSQL: partitions are made before they are needed and dropped when all in them is old.

A month is one of UTC, by the start of the window.  The default is none: a window outside every partition would be
refused, so whoever stores windows calls `ensure_months` first.  On SQLite there is one table, and nothing to do.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Table, text

from sprung.service.store.engine import Store, insert_or_ignore
from sprung.service.times import NANOSECONDS

MAKING = 0x5B_70_72_75  # of the advisory lock under which partitions are made: one process at a time
COPY_FROM = 64  # rows: for fewer, the staging table costs more than it saves
STAGING = "windows_staging"


@dataclass(frozen=True, slots=True)
class Month:
    """A month of UTC, from its first ns to the first of the next."""

    name: str  # of its partition: windows_2026_09
    begin: int
    end: int

    @classmethod
    def of(cls, start: int) -> Month:
        """The month in which a window starts, ns since epoch."""
        at = datetime.fromtimestamp(start // NANOSECONDS, UTC)
        months = 12 * at.year + at.month - 1
        return cls(f"windows_{at.year:04d}_{at.month:02d}", _first_ns(months), _first_ns(months + 1))

    @classmethod
    def named(cls, name: str) -> Month:
        """The month of a partition."""
        _, year, month = name.split("_")
        return cls.of(_first_ns(12 * int(year) + int(month) - 1))


def ensure_months(connection: Connection, starts: Iterable[int]) -> None:
    """Make the partitions for windows that start then, where they are missing.

    A new partition waits for transactions that write windows or vehicles, so that two that make one at once could wait
    for each other: `prepare` does it in a transaction of its own before.
    """
    if connection.dialect.name != "postgresql":
        return
    wanted = {month.name: month for month in map(Month.of, starts)}
    known = text("SELECT count(*) FROM unnest(CAST(:names AS text[])) AS n WHERE to_regclass(n) IS NOT NULL")
    if not wanted or connection.execute(known, {"names": list(wanted)}).scalar_one() == len(wanted):
        return
    connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": MAKING})
    for month in wanted.values():
        connection.exec_driver_sql(
            f"CREATE TABLE IF NOT EXISTS {month.name} PARTITION OF windows "
            f"FOR VALUES FROM ({month.begin}) TO ({month.end})"
        )


def prepare(store: Store, starts: Iterable[int]) -> None:
    """`ensure_months` in a transaction of its own, once a month and process."""
    if not store.many_writers:
        return
    wanted = {name: start for start in starts if (name := Month.of(start).name) not in store.months}
    if wanted:
        with store.write() as connection:
            ensure_months(connection, wanted.values())
        store.months.update(wanted)


def months(connection: Connection) -> list[Month]:
    """The months that have a partition, oldest first; none on SQLite."""
    if connection.dialect.name != "postgresql":
        return []
    query = text("SELECT inhrelid::regclass::text FROM pg_inherits WHERE inhparent = 'windows'::regclass")
    return sorted(map(Month.named, connection.execute(query).scalars()), key=lambda month: month.begin)


def drop(connection: Connection, month: Month) -> int:
    """Forget a whole month; the windows that it held."""
    held = int(connection.exec_driver_sql(f"SELECT count(*) FROM {month.name}").scalar_one())
    connection.exec_driver_sql(f"DROP TABLE {month.name}")
    return held


def size(connection: Connection, month: Month) -> int:
    """Bytes that a month takes, with its indexes."""
    query = text("SELECT pg_total_relation_size(CAST(:name AS regclass))")
    return int(connection.execute(query, {"name": month.name}).scalar_one())


def insert_new(connection: Connection, table: Table, rows: Sequence[dict[str, Any]]) -> None:
    """Insert rows whose key is not there yet: by COPY where the database has it and it pays."""
    if connection.dialect.name != "postgresql" or len(rows) < COPY_FROM:
        insert_or_ignore(connection, table, rows)
        return
    names = ", ".join(rows[0])
    connection.exec_driver_sql(
        f"CREATE TEMPORARY TABLE IF NOT EXISTS {STAGING} (LIKE {table.name}) ON COMMIT DELETE ROWS"
    )
    driver: Any = connection.connection.driver_connection
    kinds = [_BINARY[type(table.c[name].type).__name__] for name in rows[0]]
    with driver.cursor() as cursor, cursor.copy(f"COPY {STAGING} ({names}) FROM STDIN (FORMAT BINARY)") as copy:
        copy.set_types(kinds)
        for row in rows:
            copy.write_row(list(row.values()))
    connection.exec_driver_sql(
        f"INSERT INTO {table.name} ({names}) SELECT {names} FROM {STAGING} ON CONFLICT DO NOTHING"
    )
    connection.exec_driver_sql(f"TRUNCATE {STAGING}")  # a second batch of the same transaction starts empty


# PostgreSQL's names of the types of columns, for the binary format
_BINARY = {
    "BigInteger": "int8",
    "Integer": "int4",
    "Float": "float8",
    "Boolean": "bool",
    "String": "text",
    "Text": "text",
    "LargeBinary": "bytea",
}


def _first_ns(months_since_0: int) -> int:
    at = datetime(months_since_0 // 12, months_since_0 % 12 + 1, 1, tzinfo=UTC)
    return int(at.timestamp()) * NANOSECONDS
