"""Old windows as Parquet, by fleet and date: written before they are forgotten, read back by the history.

    FOLDER/fleet=north/date=2026-09-21/part-1790000000000000000-5f0c1d2e3a4b.parquet

One row a window, with the names that the table `windows` has; arrays are lists of float64, and `model` is the digest.
A vehicle's fleet is what stands before the last of `- _ . :` in its id ("north-0017" is of "north").  Files are only
added: one that is written twice, because the process died before the windows were deleted, does no harm, as windows
are read once per start.  FOLDER may be an address that pyarrow knows, such as s3://bucket/sprung.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import ColumnElement, Connection, select

from sprung.service.durable import sync_file, sync_folder
from sprung.service.errors import UserError
from sprung.service.store.schema import models, windows
from sprung.service.store.windows import pack, unpack
from sprung.service.times import NANOSECONDS

ARRAYS = ("log_ratio", "std", "per_sensor", "posterior", "posterior_std")
TOGETHER = 5000  # windows in memory at once
SEPARATOR = re.compile(r"[-_.:][^-_.:]*$")


def open_archive(place: str | None) -> Archive | None:
    """The archive that the settings name, if any."""
    return None if place is None else Archive(place)


@dataclass(frozen=True, slots=True)
class ArchivedPosterior:
    """What the tracker believed after a window, arrays packed as in the store."""

    start: int  # ns since epoch
    mean: bytes
    std: bytes


class Archive:
    """Parquet files in a folder.  Raises UserError where pyarrow is missing or the folder cannot be used."""

    def __init__(self, place: str) -> None:
        try:
            from pyarrow import fs
        except ModuleNotFoundError as error:
            raise UserError("an archive needs pyarrow: pip install 'sprung[fleet]'") from error
        try:
            if "://" in place:
                self._files, self._root = fs.FileSystem.from_uri(place)
            else:
                self._files, self._root = fs.LocalFileSystem(), str(Path(place).absolute())
            self._local = isinstance(self._files, fs.LocalFileSystem)
            self._files.create_dir(self._root, recursive=True)
        except (OSError, ValueError) as error:
            raise UserError(f"archive {place}: {str(error).splitlines()[0]}") from error

    def keep(self, connection: Connection, now: int, *which: ColumnElement[bool]) -> int:
        """Write the windows that fulfil all conditions; how many.  They are in place when this returns."""
        query = (
            select(windows, models.c.digest)
            .join(models, models.c.id == windows.c.model_id)
            .where(*which)
            .order_by(windows.c.start_ns)
        )
        kept = 0
        with ExitStack() as stack:
            parts = _Parts(self, now, stack)
            for batch in connection.execute(query.execution_options(yield_per=TOGETHER)).partitions():
                kept += len(batch)
                parts.add(batch)
        parts.publish()
        return kept

    def posteriors(self, vehicle: str, digest: str, since: int, until: int) -> Iterator[ArchivedPosterior]:
        """Those of a vehicle with since <= start < until, newest first, each window once."""
        from pyarrow import compute, dataset

        field = compute.field
        wanted = (field("vehicle_id") == vehicle) & (field("model") == digest) & field("posterior").is_valid()
        wanted &= (field("start_ns") >= since) & (field("start_ns") < until)
        last = None
        for files in self._days(fleet_of(vehicle), since, until):
            found = dataset.dataset(files, filesystem=self._files, format="parquet")
            table = found.to_table(["start_ns", "posterior", "posterior_std"], filter=wanted)
            for row in table.sort_by([("start_ns", "descending")]).to_pylist():
                if row["start_ns"] != last:
                    last = row["start_ns"]
                    yield ArchivedPosterior(last, pack(row["posterior"]), pack(row["posterior_std"]))

    def remove(self, vehicle: str) -> int:
        """Delete a vehicle's windows; how many files were written anew without them."""
        from pyarrow import compute, parquet

        changed = 0
        for files in self._days(fleet_of(vehicle), 0, 2**63 - 1):
            for path in files:
                table = parquet.read_table(path, filesystem=self._files, partitioning=None)
                rest = table.filter(compute.field("vehicle_id") != vehicle)
                if len(rest) == len(table):
                    continue
                changed += 1
                if len(rest):
                    parquet.write_table(rest, f"{path}.part", filesystem=self._files, compression="zstd")
                    self.put_in_place(path)
                else:
                    self._files.delete_file(path)
        return changed

    def put_in_place(self, path: str) -> None:
        """Give a file that was written as `.part` its name; on a disk of this machine, it survives a power cut."""
        if self._local:
            sync_file(Path(f"{path}.part"))
        self._files.move(f"{path}.part", path)
        if self._local:
            for folder in list(Path(path).parents)[: len(Path(path).relative_to(self._root).parts) + 1]:
                sync_folder(folder)

    def _days(self, fleet: str, since: int, until: int) -> Iterator[list[str]]:
        """The files of each day that the range touches, newest day first."""
        from pyarrow import fs

        folder = f"{self._root}/fleet={quote(fleet, safe='')}"
        selector = fs.FileSelector(folder, allow_not_found=True)
        days = {info.base_name.partition("=")[2]: info.path for info in self._files.get_file_info(selector)}
        for day in sorted(days, reverse=True):
            begin = int(datetime.fromisoformat(f"{day}T00:00:00+00:00").timestamp()) * NANOSECONDS
            if begin < until and begin + 86_400 * NANOSECONDS > since:
                found = self._files.get_file_info(fs.FileSelector(days[day]))
                whole = [info.path for info in found if info.base_name.endswith(".parquet")]
                if whole:
                    yield whole


class _Parts:
    """The files of one round: written under another name, published together."""

    def __init__(self, archive: Archive, now: int, stack: ExitStack) -> None:
        self._archive, self._now, self._stack = archive, now, stack
        self._writers: dict[str, Any] = {}
        self._paths: dict[str, str] = {}

    def add(self, rows: Sequence[Any]) -> None:
        """Write rows, in order of time, each into the file of its fleet and day."""
        import pyarrow

        by_place: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            by_place.setdefault(_place(row), []).append(_plain(row))
        for place, found in by_place.items():
            self._writer(place).write_table(pyarrow.Table.from_pylist(found, schema=_schema()))

    def publish(self) -> None:
        """Give the files their names, on the disk for good."""
        for path in self._writers:
            self._archive.put_in_place(path)

    def _writer(self, place: str) -> Any:
        from pyarrow import parquet

        folder = f"{self._archive._root}/{place}"
        if place not in self._paths:  # of its own: a round has several turns, in which windows of one day go
            self._paths[place] = f"{folder}/part-{self._now}-{secrets.token_hex(6)}.parquet"
        path = self._paths[place]
        if path not in self._writers:
            self._archive._files.create_dir(folder, recursive=True)
            writer = parquet.ParquetWriter(
                f"{path}.part", _schema(), filesystem=self._archive._files, compression="zstd"
            )
            self._writers[path] = self._stack.enter_context(writer)
        return self._writers[path]


def fleet_of(vehicle: str) -> str:
    """What stands before the last separator of a vehicle's id; "none" where there is no separator."""
    return SEPARATOR.sub("", vehicle) if SEPARATOR.search(vehicle) else "none"


def _place(row: Any) -> str:
    day = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=row.start_ns // NANOSECONDS)
    return f"fleet={quote(fleet_of(row.vehicle_id), safe='')}/date={day:%Y-%m-%d}"


def _plain(row: Any) -> dict[str, Any]:
    values = dict(row._mapping)
    values["model"] = values.pop("digest")
    del values["model_id"]
    for name in ARRAYS:
        values[name] = None if values[name] is None else unpack(values[name])
    identifiable = values["identifiable"]
    values["identifiable"] = None if identifiable is None else [bool(one) for one in identifiable]
    return values


def _schema() -> Any:
    import pyarrow as pa

    kinds = {"String": pa.string(), "Text": pa.string(), "BigInteger": pa.int64(), "Integer": pa.int32()}
    kinds |= {"Float": pa.float64(), "Boolean": pa.bool_(), "LargeBinary": pa.list_(pa.float64())}
    fields = [
        pa.field(column.name, kinds[type(column.type).__name__]) for column in windows.c if column.name != "model_id"
    ]
    fields = [pa.field("identifiable", pa.list_(pa.bool_())) if f.name == "identifiable" else f for f in fields]
    return pa.schema([*fields, pa.field("model", pa.string())])
