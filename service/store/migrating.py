"""Bringing a store to the newest schema.  Apart, as alembic need not be loaded where somebody else has done it."""

from __future__ import annotations

from alembic import command
from alembic.config import Config
from alembic.util import CommandError
from sqlalchemy import Connection, inspect, text

from sprung.service.errors import UserError

MIGRATING = 0x5B_70_72_74  # of the advisory lock
VERSIONS = "alembic_version"  # the table that every store of Sprung's has


def migrate(connection: Connection) -> None:
    """Bring the schema to the newest revision, inside a transaction that writes; nothing happens when it is there.

    Raises UserError for a store of a newer version, and for a file that is another program's.
    """
    config = Config()
    config.set_main_option("script_location", "sprung.service:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    if connection.dialect.name == "postgresql":  # processes that start together migrate one after the other
        connection.execute(text("SET LOCAL statement_timeout = 0"))  # however long it takes
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": MIGRATING})
    else:
        _refuse_foreign(connection)
    try:
        command.upgrade(config, "head")
    except CommandError as error:  # a revision that this version does not know
        reason = f"{_name(connection)}: a newer version of Sprung has written it; nothing was changed"
        raise UserError(reason) from error


def _refuse_foreign(connection: Connection) -> None:
    tables = set(inspect(connection).get_table_names())
    if tables and VERSIONS not in tables:
        reason = f"a database of another program (it has a table {min(tables)!r}); choose another"
        raise UserError(f"{_name(connection)}: {reason}")


def _name(connection: Connection) -> str:
    return f"store {connection.engine.url.render_as_string(hide_password=True)}"
