"""What the service needs of the machine: a store that can be written, room on the disk, files that can be opened."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from sprung.service.retrying import message_of
from sprung.service.settings import Settings
from sprung.service.store import Store
from sprung.service.store.engine import LITTLE_BYTES

FRESH_SECONDS = 1.0  # that an answer is given again: asking costs a transaction
DESCRIPTORS = 8  # that must be left
MEMORY_BYTES = 32 << 20  # likewise: the stacks of a few threads


class Condition:
    """Asked by `/health/ready`.  Safe to share between threads."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self._lock = threading.Lock()
        self._asked = -1e9
        self._known: list[str] = []

    def troubles(self) -> list[str]:
        """One line for everything that is wrong now; takes a second or two when something is."""
        with self._lock:
            if time.monotonic() - self._asked > FRESH_SECONDS:
                self._known = [
                    line for line in (self._store_trouble(), *self._file_troubles(), _memory_trouble()) if line
                ]
                self._asked = time.monotonic()
            return list(self._known)

    def _store_trouble(self) -> str:
        try:
            self._store.probe()
        except (SQLAlchemyError, OSError, TimeoutError) as error:
            return f"the store cannot be written: {message_of(error)}"
        return ""

    def _file_troubles(self) -> list[str]:
        folder = self._settings.data_dir
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as probe:
                probe.write(b"x")
            _open_some()
            free = free_bytes(folder)
        except OSError as error:
            return [f"{folder}: {error.strerror or error}"]
        found = _room_trouble(folder, free, self._settings.min_free_bytes)
        return found + self._store_room_trouble(folder)

    def _store_room_trouble(self, folder: Path) -> list[str]:
        """Of a store on another disk than the data folder's."""
        place = self._store.folder
        try:
            if place is None or place.stat().st_dev == folder.stat().st_dev:
                return []
            return _room_trouble(place, free_bytes(place), LITTLE_BYTES)
        except OSError as error:  # it is gone, or may not be entered any more
            return [f"{place}: {error.strerror or error}"]


def _room_trouble(folder: Path, free: int, needed: int) -> list[str]:
    return [f"{folder}: {free / 1e6:.0f} MB are free, {needed / 1e6:.0f} MB are needed"] if free < needed else []


def _memory_trouble() -> str:
    try:  # asked for and not touched
        mmap.mmap(-1, MEMORY_BYTES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
    except OSError:
        return f"{MEMORY_BYTES >> 20} MB of memory are not to be had"
    return ""


def _open_some() -> None:
    opened = []
    try:
        for _ in range(DESCRIPTORS):
            opened.append(os.open(os.devnull, os.O_RDONLY))
    finally:
        for number in opened:
            os.close(number)


def free_bytes(folder: Path) -> int:
    """Room on the disk of a folder."""
    return shutil.disk_usage(folder).free
