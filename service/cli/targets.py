"""Output files of long commands are checked before the work begins."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from sprung.service.errors import UserError


def check_file(path: Path | None) -> None:
    """Raises UserError, or OSError with the folder's name, for a file that cannot be written; None is none."""
    if path is None:
        return
    if path.is_dir():
        raise UserError(f"{path}: is a folder; a file is to be written")
    if not path.parent.is_dir():
        raise UserError(f"{path}: there is no folder {path.parent}")
    if not path.exists():
        _try(path.parent, path)
    elif path.is_file() and not os.access(path, os.W_OK):
        raise UserError(f"{path}: cannot be written")


def check_folder(path: Path | None) -> None:
    """The same for a folder, which need not be there yet."""
    if path is None:
        return
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise UserError(f"{path}: {'is' if there == path else f'{there} is'} a file; a folder is needed")
    _try(there, path)


def _try(folder: Path, wanted: Path) -> None:
    """Try to write there, since permissions do not reveal full or read-only disks."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        raise UserError(f"{wanted}: cannot be written: {error.strerror}") from None
