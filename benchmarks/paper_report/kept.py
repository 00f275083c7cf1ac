"""The rows that docs/paper.md was made from, in `docs/paper-rows.zip`: whoever has them makes its tables again.

The archive has a folder for each set of rows, laid out as `sprung bench paper` keeps them: `rows/` and `errors/`.
Sets are apart because they may hold the same method and seed of different arithmetic, and only rows of one set are
compared.  Errors by trajectory have single precision there.

`sprung bench paper-keep SET FOLDER` puts rows into it.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sprung.benchmarks.paper_report.document import of_several_arithmetics, read_rows
from sprung.benchmarks.paper_report.tables import name_of
from sprung.benchmarks.paper_settings import row_name
from sprung.service.errors import UserError

ARCHIVE = Path(__file__).resolve().parent.parent.parent / "docs" / "paper-rows.zip"
SETS = ("core", "variants")


@contextmanager
def opened(kept: str, archive: Path | None = None) -> Iterator[Path]:
    """A set of the archive as a folder.  Errors: `UserError` where there is no such set, or no archive."""
    place = archive or ARCHIVE
    with TemporaryDirectory(prefix="sprung-paper-") as folder:
        try:
            with zipfile.ZipFile(place) as file:
                names = [name for name in file.namelist() if name.startswith(f"{kept}/")]
                there = ", ".join(sorted({name.partition("/")[0] for name in file.namelist()}))
                file.extractall(folder, names)
        except (OSError, zipfile.BadZipFile) as error:
            raise UserError(f"{place}: no archive of rows: {error}") from error
        if not names:
            raise UserError(f"{place}: no rows {kept!r}; it has {there or 'none'}")
        yield Path(folder) / kept


def run(
    kept: str = "core", data: Path | None = None, *, methods: str | None = None, archive: Path | None = None
) -> Iterator[dict[str, Any]]:
    """One dict per task and method whose rows of `data` were put into the archive.

    kept: the set; data: folder of the budget, runs/paper/quick by default;
    methods: several between commas, all by default.
    """
    if kept not in SETS:
        raise UserError(f"bench paper-keep: no set {kept!r}; known are {', '.join(SETS)}")
    data = data or Path("runs/paper/quick")
    try:
        rows = read_rows(data)
    except (ValueError, OSError) as error:
        raise UserError(f"bench paper-keep: {error}") from error
    chosen = [row for row in rows if methods is None or name_of(row) in methods.split(",")]
    if not chosen:
        raise UserError(f"bench paper-keep: {data}: no rows{f' of {methods}' if methods else ''}")
    place = archive or ARCHIVE
    files = _read(place)
    seeds_of: dict[tuple[str, str], list[int]] = {}
    for row in chosen:
        name = row_name(row, row.get("seed", 0))
        files[f"{kept}/rows/{name}.json"] = (json.dumps(row) + "\n").encode()
        errors = data / "errors" / f"{name}.npz"
        if errors.is_file():
            files[f"{kept}/errors/{name}.npz"] = _single(errors)
        seeds_of.setdefault((row["task"], name_of(row)), []).append(row.get("seed", 0))
    together = [json.loads(text) for name, text in files.items() if name.startswith(f"{kept}/rows/")]
    if mixed := of_several_arithmetics(together):
        raise UserError(
            f"bench paper-keep: {data}: {', '.join(mixed)}: the set {kept!r} would hold rows of different arithmetic,"
            " which may not be compared; nothing was kept"
        )
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for name in sorted(files):
            file.writestr(zipfile.ZipInfo(name), files[name], zipfile.ZIP_DEFLATED)
    for (task, method), seeds in seeds_of.items():
        yield {"kept": kept, "task": task, "method": method, "seeds": seeds}


def _read(archive: Path) -> dict[str, bytes]:
    if not archive.is_file():
        return {}
    with zipfile.ZipFile(archive) as file:
        return {name: file.read(name) for name in file.namelist()}


def _single(path: Path) -> bytes:
    """Errors by trajectory with single precision."""
    written = io.BytesIO()
    with np.load(path) as errors:
        np.savez(written, **{key: errors[key].astype(np.float32) for key in errors.files})
    return written.getvalue()
