"""Parquet tables (extra `parquet`), through pyarrow, a batch of rows at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.signals import Channel, SampleBlock, TimeColumn
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.bounds import check_samples, check_whole
from sprung.replay.csvlayout import unit_in
from sprung.replay.extras import needed
from sprung.replay.tables import ROWS, Rows, time_name


def blocks(path: Path, channels: Sequence[Channel], account: Account, time: TimeColumn) -> Iterator[SampleBlock]:
    """Blocks in the order of the rows."""
    needed("pyarrow", "parquet", path)
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            time = stamped(file.schema_arrow, time)
            rows = Rows(
                path, names, units(file), channels, time, account, zoned=not _zoneless(file.schema_arrow, names, time)
            )
            check_samples(path, file.metadata.num_rows * max(len(rows.columns), 1))
            _check_unpacked(path, file.metadata)
            wanted = ([] if rows.time is None else [names[rows.time]]) + [names[i] for i in rows.columns]
            for batch in file.iter_batches(batch_size=ROWS, columns=list(dict.fromkeys(wanted))):
                values = np.stack([_floats(batch.column(names[i]), names[i], path) for i in rows.columns], axis=1)
                yield rows.block(None if rows.time is None else _times(batch.column(names[rows.time])), values)
    except (pa.ArrowException, OSError) as error:
        raise UnreadableRecording(f"{path}: not a Parquet file that can be read: {error}") from error


def stamped(schema: Any, time: TimeColumn) -> TimeColumn:
    """Location of the times: without a name, the only column of time stamps, such as a data frame's index."""
    import pyarrow as pa

    stamps = [field.name for field in schema if pa.types.is_timestamp(field.type)]
    if time.rate is not None or len(stamps) != 1 or time_name(schema.names, time) is not None:
        return time
    return replace(time, name=stamps[0])


def _zoneless(schema: Any, names: Sequence[str], time: TimeColumn) -> bool:
    """Whether the times are stamps of which the file does not say in which zone they are."""
    import pyarrow as pa

    name = time_name(names, time)
    kind = schema.field(name).type if name in names else None
    return kind is not None and pa.types.is_timestamp(kind) and kind.tz is None


def listing(path: Path, time: TimeColumn) -> tuple[list[tuple[str, str | None]], TimeColumn]:
    """Name and unit of every column of numbers or times, and where the times are."""
    needed("pyarrow", "parquet", path)
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            kinds = file.schema_arrow.types
            numeric = [pa.types.is_floating(k) or pa.types.is_integer(k) or pa.types.is_timestamp(k) for k in kinds]
            pairs = zip(file.schema_arrow.names, units(file), strict=True)
            kept = [pair for pair, keep in zip(pairs, numeric, strict=True) if keep]
            return kept, stamped(file.schema_arrow, time)
    except (pa.ArrowException, OSError) as error:
        raise UnreadableRecording(f"{path}: not a Parquet file that can be read: {error}") from error


def units(file: Any) -> list[str | None]:
    """Units of the columns: the field's metadata `unit`, else the unit in its name."""
    found = []
    for field in file.schema_arrow:
        stated = (field.metadata or {}).get(b"unit") or (field.metadata or {}).get(b"units")
        found.append(stated.decode("utf-8", "replace") if stated else unit_in(field.name)[1])
    return found


def _check_unpacked(path: Path, metadata: Any) -> None:
    """Raise UnreadableRecording when a file states that it unpacks to more than is plausible for its size.

    Row groups are asked, not their columns: pyarrow ends the process where a column's statistics are damaged.
    """
    check_whole(path, (metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups)))


def _floats(column: Any, name: str, path: Path) -> Any:
    values = column.to_numpy(zero_copy_only=False)
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError):
        raise UnreadableRecording(f"{path}: column {name!r} holds {column.type}, not numbers") from None


def _times(column: Any) -> Any:
    values = column.to_numpy(zero_copy_only=False)
    return values if values.dtype.kind != "O" else [str(cell) for cell in values]
