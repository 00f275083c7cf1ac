"""CSV tables: a header row, a column `time` in seconds, the other columns named in the system file."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

import numpy as np

from sprung.model.signals import Channel, FloatArray, SampleBlock
from sprung.replay.account import Account, UnreadableRecording

TIME = "time"
BATCH_ROWS = 4096


def blocks(path: Path, channels: Sequence[Channel], account: Account) -> Iterator[SampleBlock]:
    """Blocks of some thousand rows; empty and NaN cells are missing values, unreadable rows corrupt."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        header_line = file.readline()
        separator = ";" if header_line.count(";") > header_line.count(",") else ","
        names = [name.strip() for name in next(csv.reader([header_line], delimiter=separator), [])]
        wanted = _columns(path, names, channels)
        index = np.array([place for place, _ in wanted], dtype=np.int32)
        columns = [names.index(TIME), *(column for _, column in wanted)]
        for name in names:
            account.contents[name] = 0
        while lines := list(islice(file, BATCH_ROWS)):
            yield _block(lines, separator, len(names), columns, index, account)


def _columns(path: Path, names: list[str], channels: Sequence[Channel]) -> list[tuple[int, int]]:
    """(channel, column) of every channel that the table has; raises when it has none or no time."""
    if TIME not in names:
        raise UnreadableRecording(f"{path}: no column {TIME!r} (seconds); its columns: {_some(names)}")
    named = [(place, name) for place, channel in enumerate(channels) if (name := channel.csv or channel.column)]
    if not named:
        raise UnreadableRecording(
            "the system file names no CSV column; give its channels `csv: column` to read CSV recordings"
        )
    found = [(place, names.index(column)) for place, column in named if column in names]
    lacking = [column for _, column in named if column not in names]
    if not found or any(get_close_matches(column, names, n=1, cutoff=0.8) for column in lacking):
        near = {column: get_close_matches(column, names, n=2, cutoff=0.3) for column in lacking}
        hints = "; ".join(f"{column!r} (nearest: {_some(close or names)})" for column, close in near.items())
        raise UnreadableRecording(f"{path}: columns not found: {hints}")
    return found


def _block(
    lines: list[str],
    separator: str,
    width: int,
    columns: list[int],
    index: np.ndarray,
    account: Account,
) -> SampleBlock:
    table = _fast(lines, separator, width, columns)
    if table is None:
        table = _careful(lines, separator, width, columns, account)
    stamped = np.isfinite(table[:, 0])
    account.corrupt(int((~stamped).sum()), "row without a time")
    table = table[stamped]
    values = table[:, 1:]
    empty = np.isnan(values)
    account.drop(int(empty.all(axis=1).sum()), "no valid value")
    account.tally.used += int((~empty.all(axis=1)).sum())
    account.values["empty or NaN"] += int(empty.sum())
    time = np.round(table[:, 0] * 1e9).astype(np.int64)
    return SampleBlock(np.repeat(time, len(index)), np.tile(index, len(table)), values.reshape(-1).copy())


def _fast(lines: list[str], separator: str, width: int, columns: list[int]) -> FloatArray | None:
    """NumPy's reader for batches in which every cell of the wanted columns is a number."""
    if any(line.count(separator) != width - 1 or '"' in line for line in lines):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.loadtxt(io.StringIO("".join(lines)), delimiter=separator, usecols=columns, ndmin=2, comments=None)
    except (ValueError, UserWarning):
        return None


def _careful(lines: list[str], separator: str, width: int, columns: list[int], account: Account) -> FloatArray:
    rows = []
    for row in csv.reader(lines, delimiter=separator):
        if not row:
            continue
        if len(row) != width:
            account.corrupt(1, "row of the wrong length")
            continue
        try:
            rows.append([_number(row[column]) for column in columns])
        except ValueError:
            account.corrupt(1, "cell is no number")
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _number(cell: str) -> float:
    text = cell.strip().lower()
    if text in ("", "nan", "na", "n/a", "null", "none", "-"):
        return float("nan")
    value = float(text)
    return value if np.isfinite(value) else float("nan")


def _some(names: list[str]) -> str:
    return ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
