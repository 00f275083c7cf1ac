"""A service that is killed right after it has committed what a request asked for, before anything is answered.

    python -m tests.killed_service DATA_DIR PATH REQUEST

REQUEST is the JSON of what `TestClient.post` takes; of a file, its name and content as a list.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fastapi.testclient import TestClient
from sqlalchemy import Connection, func, select

from sprung.model.system import MANCHESTER_DBC, load_system
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.settings import Settings
from sprung.service.store import Store
from sprung.service.store.schema import audit
from tests.service_fakes import FakeIdentifier


def kill_after_a_deed() -> None:
    """From now on the process dies behind the transaction that adds a line to the audit log."""
    write = Store.write

    @contextmanager
    def deadly(store: Store) -> Iterator[Connection]:
        with write(store) as connection:
            before = _deeds(connection)
            yield connection
            done = _deeds(connection) > before
        if done:
            os.kill(os.getpid(), signal.SIGKILL)

    Store.write = deadly  # type: ignore[method-assign, assignment]


def _deeds(connection: Connection) -> int:
    return int(connection.execute(select(func.count()).select_from(audit)).scalar_one())


def main(data_dir: str, path: str, request: str) -> None:
    """Serve one request, and die."""
    system = load_system()
    engine = Engine(system, FakeIdentifier(system), make_tracker(system), MANCHESTER_DBC)
    with TestClient(create_app(build_core(Settings(data_dir=Path(data_dir)), engine))) as client:
        kill_after_a_deed()
        wanted = json.loads(request)
        client.post(path, **wanted | {"files": {k: tuple(v) for k, v in wanted.get("files", {}).items()} or None})


if __name__ == "__main__":
    main(*sys.argv[1:])
