"""Recordings in a folder, or behind an address such as s3://bucket/folder."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sprung.service.errors import UserError

KINDS = (".mcap", ".blf", ".asc", ".log", ".mf4", ".csv", ".parquet", ".mat", ".h5", ".hdf5", ".tdms")


@dataclass(frozen=True, slots=True)
class FoundFile:
    """A recording in its place."""

    path: str
    size: int
    modified_ns: int
    vehicle: str = ""
    first_ns: int = 0  # of its samples
    problem: str = ""  # why it cannot be read
    options: str = ""  # of an address, as in ?endpoint_override=...

    @property
    def id(self) -> str:
        """The recording's id in the store; another one when the file changes."""
        return hashlib.sha256(f"{self.path} {self.size} {self.modified_ns}".encode()).hexdigest()[:36]


def list_recordings(place: str) -> list[FoundFile]:
    """Recordings in a folder and those below it.  Raises UserError for a place that has none or cannot be listed."""
    found = _list_files(place)
    if not found:
        raise UserError(f"{place}: no recordings ({' '.join(KINDS)})")
    return found


def _list_files(place: str) -> list[FoundFile]:
    """The same, which may be none."""
    if "://" not in place:
        folder = Path(place)
        if not folder.is_dir():
            raise UserError(f"{place}: no such folder")
        paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in KINDS and path.is_file())
        return [FoundFile(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    try:
        from pyarrow import fs

        files, root = fs.FileSystem.from_uri(place)
        infos = files.get_file_info(fs.FileSelector(root, recursive=True))
    except ModuleNotFoundError as error:
        raise UserError("addresses need pyarrow: pip install 'sprung[fleet]'") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{place}: {str(error).splitlines()[0]}") from error
    prefix = place[: place.index("://") + 3]
    options = "?" + place.partition("?")[2] if "?" in place else ""
    return sorted(
        (
            FoundFile(f"{prefix}{info.path}", info.size, info.mtime_ns or 0, options=options)
            for info in infos
            if info.is_file and Path(info.path).suffix.lower() in KINDS
        ),
        key=lambda file: file.path,
    )


@contextmanager
def local_copy(file: FoundFile) -> Iterator[Path]:
    """A file that readers can open; one from an address is fetched for a while."""
    if "://" not in file.path:
        yield Path(file.path)
        return
    from pyarrow import fs

    files, inner = fs.FileSystem.from_uri(file.path + file.options)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / Path(inner).name
        with files.open_input_stream(inner) as source, path.open("wb") as copy:
            shutil.copyfileobj(source, copy)
        yield path
