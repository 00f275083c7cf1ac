"""A temporary PostgreSQL server of this process: for the demo, benchmarks and tests, where the binaries are there."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

SETTINGS = (  # it may lose its data: a disk that is waited for makes them slow
    "fsync=off",
    "synchronous_commit=off",
    "full_page_writes=off",
    "max_connections=120",
    "shared_buffers=32MB",
)


def binaries() -> Path | None:
    """The folder of PostgreSQL's programs; Debian keeps them off the path."""
    found = shutil.which("initdb")
    places = [Path(found).resolve().parent] if found else []
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((place for place in places if (place / "initdb").exists()), None)


def missing() -> str:
    """Why there can be no server here; empty where there can."""
    try:
        import psycopg  # noqa: F401
    except ImportError:
        return "psycopg is not installed"
    if binaries() is None:
        return "no PostgreSQL server is installed"
    if os.geteuid() == 0 and _user() is None:
        return "PostgreSQL does not run as root, and there is no user postgres or nobody"
    return ""


@dataclass
class PostgresServer:
    """A cluster in a folder; `start` and `kill` as often as one likes."""

    folder: Path
    port: int
    durable: bool = False
    _made: int = field(default=0)

    def start(self) -> None:
        """Start and wait until connections are taken."""
        settings = [] if self.durable else [f"-c {setting}" for setting in SETTINGS]
        options = [f"-p {self.port}", "-c listen_addresses=127.0.0.1", f"-k {self.folder}", *settings]
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-w", "-l", str(self.folder / "log"), "-o",
                  " ".join(options), "start")  # fmt: skip

    def stop(self, mode: str = "immediate") -> None:
        """Stop; `immediate` behaves like a power cut."""
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-m", mode, "-w", "stop", check=False)

    def pid(self) -> int:
        """Of the postmaster."""
        return int((self.folder / "data" / "postmaster.pid").read_text().splitlines()[0])

    def database(self, template: str = "template1") -> str:
        """The URL of a new database, which holds what its template does: by default nothing."""
        import psycopg

        self._made += 1
        name = f"sprung_{self._made}"
        with psycopg.connect(self.url("postgres").replace("+psycopg", ""), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name} TEMPLATE {template}")
        return self.url(name)

    def url(self, name: str) -> str:
        """Of a database."""
        return f"postgresql+psycopg://sprung@127.0.0.1:{self.port}/{name}"

    def initdb(self) -> None:
        """Make the cluster."""
        self._run("initdb", "-D", str(self.folder / "data"), "-U", "sprung", "-A", "trust", "-E", "UTF8",
                  "--locale=C", "--no-sync")  # fmt: skip

    def _run(self, program: str, *arguments: str, check: bool = True) -> None:
        place = binaries()
        assert place is not None, "asked for a server where there can be none"
        user = _user() if os.geteuid() == 0 else None
        subprocess.run(
            [str(place / program), *arguments],
            check=check,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
            user=user,
            cwd="/",
        )


@contextmanager
def server(durable: bool = False) -> Iterator[PostgresServer]:
    """A running server; it is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="sprung-pg-", dir="/tmp") as name:  # nosec B108: a new folder
        folder = Path(name)
        user = _user()
        if os.geteuid() == 0 and user is not None:
            shutil.chown(folder, user=user)
        found = PostgresServer(folder, free_port(), durable)
        found.initdb()
        found.start()
        try:
            yield found
        finally:
            found.stop()


def _user() -> str | None:
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name).pw_name
        except KeyError:
            continue
    return None


def free_port() -> int:
    """A port of this machine that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
