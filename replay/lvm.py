"""LabVIEW measurement files (`.lvm`): text with a header, then segments of columns with the times they state.

Layout: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sprung.replay.account import UnreadableRecording
from sprung.replay.stamps import SECOND
from sprung.replay.tables import Column, EvenTimes, whole

END = "***End_of_Header***"
_SEPARATORS = {"tab": "\t", "comma": ","}


@dataclass(frozen=True, slots=True)
class _Segment:
    """One block of rows with its header's description of every column."""

    header: Mapping[str, Sequence[str]]
    names: Sequence[str]
    rows: Sequence[Sequence[str]]


def columns(path: Path) -> list[Column]:
    """The channels by their names; `name #2` where a further segment has the same one.  Errors: UnreadableRecording."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        raise UnreadableRecording(f"{path}: not a LabVIEW measurement file (whose first line is 'LabVIEW Measurement')")
    start = next((i + 1 for i, line in enumerate(lines) if line.startswith(END)), len(lines))
    head = (line.split("\t") if "\t" in line else line.split(",") for line in lines[:start])
    words = {cells[0]: cells[1:] for cells in head}
    separator = _SEPARATORS.get("".join(words.get("Separator", ["Tab"])[:1]).strip().lower(), "\t")
    point = "".join(words.get("Decimal_Separator", ["."])[:1]).strip() or "."
    shape = "".join(words.get("X_Columns", ["One"])[:1]).strip().lower()
    found: list[Column] = []
    seen: Counter[str] = Counter()
    try:
        for segment in _segments(lines[start:], separator):
            for column in _of_segment(segment, point, shape):
                number = seen[column.name] = seen[column.name] + 1
                found.append(column if number == 1 else replace(column, name=f"{column.name} #{number}"))
    except (ValueError, IndexError, OverflowError) as error:
        raise UnreadableRecording(f"{path}: a damaged segment: {error}") from error
    if not found:
        raise UnreadableRecording(f"{path}: no segment of numbers in it")
    return found


def _segments(lines: Sequence[str], separator: str) -> Iterator[_Segment]:
    """Segments of the lines after the file's own header."""
    at = 0
    while at < len(lines):
        end = next((i for i in range(at, len(lines)) if lines[i].startswith(END)), None)
        if end is None or end + 1 >= len(lines):
            return
        header = {cells[0].strip(): cells[1:] for cells in (line.split(separator) for line in lines[at:end])}
        names = [name.strip() for name in lines[end + 1].split(separator)]
        rows, at = [], end + 2
        while at < len(lines) and lines[at].strip() and not lines[at].startswith("Channels"):
            rows.append(lines[at].split(separator))
            at += 1
        if rows:
            yield _Segment(header, names, rows)
        while at < len(lines) and not lines[at].strip():
            at += 1


def _of_segment(segment: _Segment, point: str, shape: str) -> Iterator[Column]:
    """The channels of a segment; shape: "one" column of times, "multi" (one beside every channel) or "no"."""
    names = [name for name in segment.names if name.lower() != "comment"]
    values = np.array([_numbers(row, len(names), point) for row in segment.rows])
    wrong = np.isinf(values).sum(axis=0)  # cells that are no numbers, or none that could be measured
    timed = shape == "multi"
    channels = [i for i, name in enumerate(names) if not name.startswith("X_Value")]
    for order, i in enumerate(channels):
        series, clock = values[:, i], _clock(segment.header, order)
        good = np.flatnonzero(np.isfinite(series))
        series = np.where(np.isfinite(series), series, np.nan)[: good[-1] + 1 if len(good) else 0]  # shorter columns
        x = (values[:, i - 1] if timed else values[:, 0])[good]
        if clock is None and shape != "no" and len(good) > 1:
            step = float((x[-1] - x[0]) / (good[-1] - good[0]))
            clock = EvenTimes(round((float(x[0]) - int(good[0]) * step) * SECOND), step, True)
        unit = _at(segment.header.get("Y_Unit_Label", ()), order)
        found = whole(names[i] or f"channel {order + 1}", series, unit, clock)
        yield replace(found, lacking=int(wrong[i]))


def _numbers(row: Sequence[str], count: int, point: str) -> list[float]:
    cells = [cell.strip().replace(point, ".") if point != "." else cell.strip() for cell in row[:count]]
    return [_number(cell) for cell in cells] + [np.nan] * (count - len(cells))


def _number(cell: str) -> float:
    """NaN for an empty cell, infinity for one that is no number."""
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        return np.inf


def _at(said: Sequence[str], place: int) -> str | None:
    return said[place].strip() or None if place < len(said) else None


def _clock(header: Mapping[str, Sequence[str]], place: int) -> EvenTimes | None:
    """Times by X0, Delta_X and, where they are stated, date and time of the first sample."""
    step, first = _at(header.get("Delta_X", ()), place), _at(header.get("X0", ()), place) or "0"
    if step is None or not float(step.replace(",", ".")) > 0:
        return None
    offset = round(float(first.replace(",", ".")) * SECOND)
    day, hour = _at(header.get("Date", ()), place), _at(header.get("Time", ()), place)
    began = _nanoseconds(day, hour) if day is not None and hour is not None else 0
    return EvenTimes(began + offset, float(step.replace(",", ".")), began == 0)


def _nanoseconds(day: str, hour: str) -> int:
    """Since the Unix epoch; the file states no time zone; UTC is assumed."""
    whole_seconds, _, fraction = hour.replace(",", ".").partition(".")
    when = datetime.strptime(f"{day} {whole_seconds}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
    return int(when.timestamp()) * SECOND + round(float(f"0.{fraction or 0}") * SECOND)
