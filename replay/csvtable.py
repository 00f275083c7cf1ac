"""Text tables (.csv .tsv .txt .dat): any separator, decimal sign, header, comment lines, units row, kind of time."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sprung.model.signals import ANY_TIME, Channel, FloatArray, SampleBlock, TimeColumn
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.csvlayout import COMMENTS, SAMPLE, TableLayout, cells, is_number, number, sniff
from sprung.replay.tables import Rows

BATCH_ROWS = 4096
CHUNK = 1 << 20  # characters that are read at once; a line that is longer is damage


def blocks(
    path: Path, channels: Sequence[Channel], account: Account, time: TimeColumn = ANY_TIME
) -> Iterator[SampleBlock]:
    """Blocks of some thousand rows; empty and NaN cells are missing values, unreadable rows corrupt."""
    layout, head = read_layout(path)
    rows = Rows(path, layout.names, layout.units, channels, time, account, timed=layout.timed, csv=True)
    reader = _Reader(layout, rows, account)
    if layout.comma:
        account.note("the decimal sign is a comma")
    if layout.headed is False:
        account.note(f"no header: the columns are numbered 1 to {len(layout.names)}")
    waiting: list[str] = []
    for number_, line in enumerate(_lines(path, head.encoding, account)):
        if number_ < layout.skip:
            continue
        waiting.append(line)
        if len(waiting) >= BATCH_ROWS:
            yield reader.block(waiting)
            waiting = []
    if waiting:
        yield reader.block(waiting)


class Head:
    """The first lines of a file and their encoding."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            raw = file.read(CHUNK)
        self.encoding = _encoding(raw)
        text = raw.decode(self.encoding, errors="replace")
        if 20 * text.count("\0") > len(text):
            raise UnreadableRecording(f"{path}: not a text table (it holds binary data)")
        lines = text.splitlines()
        self.lines = lines[: 2 * SAMPLE] if len(raw) < CHUNK or len(lines) > 1 else []


def read_layout(path: Path) -> tuple[TableLayout, Head]:
    """What the table looks like; raises UnreadableRecording when it is none."""
    head = Head(path)
    layout = sniff(head.lines)
    if layout is None:
        begins = f"it begins with {' '.join(head.lines[0].split())[:60]!r}" if head.lines else "it is empty"
        if not head.lines and path.stat().st_size:
            begins = f"the first one is longer than {CHUNK >> 20} MB"
        raise UnreadableRecording(f"{path}: no rows of numbers in its first lines; {begins}")
    return layout, head


def _encoding(raw: bytes) -> str:
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        raw[:-4].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _lines(path: Path, encoding: str, account: Account) -> Iterator[str]:
    """The lines of a file, however they end; one that is longer than CHUNK is passed over."""
    rest, skipping = "", False
    with path.open(encoding=encoding, errors="replace", newline=None) as file:
        while chunk := file.read(CHUNK):
            *complete, rest = (rest + chunk).split("\n")
            if skipping and complete:
                complete, skipping = complete[1:], False
            yield from complete
            if len(rest) > CHUNK:
                if not skipping:
                    account.corrupt(1, "line longer than a mebibyte")
                rest, skipping = "", True
    if rest and not skipping:
        yield rest


class _Reader:
    """Lines to blocks of samples."""

    def __init__(self, layout: TableLayout, rows: Rows, account: Account) -> None:
        self.layout, self.rows, self.account = layout, rows, account
        self.columns = ([] if rows.time is None else [rows.time]) + rows.columns
        self.written: bool | None = None  # the time is written as a date, not as a number

    def block(self, lines: list[str]) -> SampleBlock:
        """The rows of some lines."""
        lines = [line for line in lines if line and not line.startswith(COMMENTS) and not line.isspace()]
        if self.written is None:
            self.written = self._is_written(lines)
        table = None if self.written else self._fast(lines)
        times: list[str] | None = None
        if table is None:
            times, table = self._careful(lines)
        if self.rows.time is None:
            return self.rows.block(None, table)
        if self.written:
            return self.rows.block(times or [], table)
        return self.rows.block(table[:, 0], table[:, 1:])

    def _is_written(self, lines: list[str]) -> bool:
        if self.rows.time is None:
            return False
        for line in lines:
            try:
                row = cells(line, self.layout.separator)
            except csv.Error:
                continue
            if len(row) == len(self.layout.names) and row[self.rows.time]:
                return not is_number(row[self.rows.time], self.layout.comma)
        return False

    def _fast(self, lines: list[str]) -> FloatArray | None:
        """NumPy's reader for batches in which every cell of the wanted columns is a number."""
        separator, width = self.layout.separator, len(self.layout.names)
        text = "\n".join(lines)
        if not lines or '"' in text or "_" in text or not text.isascii():
            return None
        if separator is None:
            if any(len(line.split()) != width for line in lines):
                return None
        elif any(line.count(separator) != width - 1 for line in lines):
            return None
        if self.layout.comma:
            text = text.replace(",", ".")
        try:
            table = np.loadtxt(io.StringIO(text), delimiter=separator, usecols=self.columns, ndmin=2, comments=None)
        except ValueError:
            return None
        return np.where(np.isfinite(table), table, np.nan)

    def _careful(self, lines: list[str]) -> tuple[list[str], FloatArray]:
        """Cell by cell; what cannot be read is counted."""
        separator, comma, width = self.layout.separator, self.layout.comma, len(self.layout.names)
        columns = self.columns[1:] if self.written else self.columns
        rows, times = [], []
        for line in lines:
            try:
                row = cells(line, separator)
            except csv.Error:
                row = []
            if len(row) != width:
                self.account.corrupt(1, "row of the wrong length")
                continue
            try:
                rows.append([number(row[column], comma) for column in columns])
            except ValueError:
                self.account.corrupt(1, "cell is no number")
                continue
            if self.written:
                times.append(row[self.columns[0]])
        return times, np.array(rows, dtype=np.float64).reshape(-1, len(columns))
