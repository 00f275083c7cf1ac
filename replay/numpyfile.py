"""NumPy files: `.npy` (one array) and `.npz` (several by name); without pickled objects, which could run code."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from sprung.replay.account import UnreadableRecording
from sprung.replay.bounds import check_whole

Arrays = Iterator[tuple[str, NDArray[Any] | str]]


def arrays(path: Path) -> Arrays:
    """Every array with its name, or why it cannot be read; columns of structured ones as `name.field`.

    Errors: UnreadableRecording.
    """
    try:
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as packed:
                check_whole(path, (one.file_size for one in packed.infolist()))
            with np.load(path, allow_pickle=False) as content:
                for name in content.files:
                    try:
                        found = _member(content, name)
                    except Exception as error:  # of whatever unpacks and parses: it costs itself
                        yield name, str(error) or type(error).__name__
                        continue
                    if found is not None:
                        yield from _fields(name, found)
        else:
            yield from _fields("data", np.load(path, allow_pickle=False))
    except UnreadableRecording:
        raise
    except (ValueError, OSError, EOFError, KeyError, SyntaxError, zipfile.BadZipFile) as error:
        raise UnreadableRecording(f"{path}: not a NumPy file that can be read: {error}") from error


def _member(content: NpzFile, name: str) -> NDArray[Any] | None:
    """An array; None for what is none: notes beside the arrays, and pickled objects, which `np.savez` makes of them."""
    try:
        found = content[name]
    except ValueError as error:
        if "allow_pickle" in str(error):
            return None
        raise
    return found if isinstance(found, np.ndarray) else None


def _fields(name: str, values: NDArray[Any]) -> Arrays:
    if values.dtype.names:
        for field in values.dtype.names:
            yield f"{name}.{field}", values[field]
    else:
        yield name, values
