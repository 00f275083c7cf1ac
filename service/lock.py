"""One service a data folder: two would delete what the other has half written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from sprung.service.errors import UserError

NAME = "sprung.lock"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the folder, made when absent, until the block ends; a process that dies lets go of it.

    Raises UserError when another service holds it; OSError where nothing can be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise UserError(
            f"{folder}: another sprung serve{_process(path)} works on this data folder; "
            "stop it, or give this one its own --data-dir"
        ) from None
    note = path.with_suffix(".pid")
    try:
        note.write_text(f"{os.getpid()}\n", encoding="ascii")
        yield
    finally:
        with suppress(OSError):
            note.unlink(missing_ok=True)
        lock.release()


def _process(path: Path) -> str:
    """Which one, as far as it says."""
    with suppress(OSError, ValueError):
        return f" (process {int(path.with_suffix('.pid').read_text(encoding='ascii'))})"
    return ""
