"""What a text table looks like: separator, decimal sign, lines before the data, header and units."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from sprung.model.units import RAW, known
from sprung.replay.stamps import is_written

COMMENTS = ("#", "%", "//", "!", "*")
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "-nan", "#n/a", "nan.0", "1.#qnan", "-1.#ind"})
SAMPLE = 200  # lines of data that are looked at
_NUMBER = re.compile(r"^[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?$", re.ASCII)
_SPECIAL = re.compile(r"^[+-]?(?:inf|infinity)$", re.IGNORECASE)
_RISES = 0.9  # of the steps of a column of times, that go forwards: some clocks are set back
_QUANTITIES = ("m", "m/s", "m/s^2", "rad/s", "N", "Pa", "kg", "s")
_OTHER_UNITS = frozenset({"degc", "°c", "c", "k", "hz", "deg", "rad", "nm", "w", "kw", "db", "strain", "um/m", "-"})
_IN_NAME = re.compile(
    r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\]]*)\]|\((?P<round>[^)]*)\)|(?:/|,\s*|\bin\s+)(?P<bare>\S+))$"
)


@dataclass(frozen=True, slots=True)
class TableLayout:
    """How to read the rows of a table."""

    separator: str | None  # None: runs of blanks
    comma: bool  # the decimal sign is a comma
    skip: int  # lines before the first row of data
    names: tuple[str, ...]  # of the columns; "1", "2", ... when there is no header
    units: tuple[str | None, ...]  # of the columns, from a row of units or the header
    headed: bool
    numeric: tuple[bool, ...]  # which columns hold numbers or times
    timed: bool = False  # without a header: whether the first column rises, as times do


def cells(line: str, separator: str | None) -> list[str]:
    """The cells of one line; raises csv.Error."""
    if separator is None:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def number(cell: str, comma: bool) -> float:
    """The value of a cell, NaN for markers of missing values; raises ValueError."""
    text = cell.replace(",", ".") if comma else cell
    if _NUMBER.match(text):
        return float(text.replace("d", "e").replace("D", "e"))
    if text.lower() in MISSING or _SPECIAL.match(text):
        return float("nan")
    raise ValueError(cell)


def is_number(cell: str, comma: bool) -> bool:
    """Whether a cell holds a number."""
    return _NUMBER.match(cell.replace(",", ".") if comma else cell) is not None


def sniff(lines: list[str]) -> TableLayout | None:
    """The layout of a table that begins with these lines; None when no rows of numbers are among them."""
    best: tuple[float, TableLayout] | None = None
    for separator, comma in _ways(lines):
        found = _try(lines, separator, comma)
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    return best[1] if best else None


def _ways(lines: list[str]) -> Iterator[tuple[str | None, bool]]:
    """Separators and decimal signs, likely ones first."""
    text = "\n".join(lines)
    for separator in (",", ";", "\t", "|"):
        if separator in text:
            yield separator, False
            if "," in text and (separator != "," or '"' in text):
                yield separator, True
    yield None, False
    if "," in text:
        yield None, True


def _try(lines: list[str], separator: str | None, comma: bool) -> tuple[float, TableLayout] | None:
    """Score of a reading of the lines, by the number of cells that are understood, and its layout; None if none."""
    rows = [_cells_of(line, separator) for line in lines]
    good = [[is_number(cell, comma) or is_written(cell) for cell in row] for row in rows]
    width = _width(rows, good)
    if not width:
        return None
    of_width = [i for i, row in enumerate(rows) if len(row) == width]
    numeric = [sum(good[i][c] for i in of_width) > 0.5 * len(of_width) for c in range(width)]
    if not any(numeric):
        numeric = [any(good[i][c] for i in of_width) for c in range(width)]
    first = next((i for i in of_width if _is_data(rows[i], good[i], numeric)), None)
    if first is None:
        return None
    data = [i for i in of_width if i >= first][:SAMPLE]
    understood = sum(good[i][c] or rows[i][c].lower() in MISSING for i in data for c in range(width))
    others = sum(len(row) not in (0, width) for row in rows[first:])
    score = understood - 2.0 * others - 0.5 * sum(len(data) * (not n) for n in numeric)
    return score, _layout(lines, rows, first, tuple(numeric), separator, comma)


def _cells_of(line: str, separator: str | None) -> list[str]:
    """The cells of a line; none in comments, empty lines and lines that cannot be split."""
    if not line.strip() or line.lstrip().startswith(COMMENTS):
        return []
    try:
        return cells(line, separator)
    except csv.Error:
        return []


def _width(rows: list[list[str]], good: list[list[bool]]) -> int:
    """The number of columns of the rows that hold mostly numbers; 0 if there are none."""
    widths = Counter(len(row) for row, ok in zip(rows, good, strict=True) if any(ok) and 2 * sum(ok) >= len(row))
    return max(widths, key=lambda width: (widths[width] * width, width), default=0)


def _is_data(row: list[str], good: list[bool], numeric: list[bool]) -> bool:
    """A row of data has numbers, or nothing, in most of the columns of numbers."""
    fits = sum(ok or cell.lower() in MISSING for cell, ok, n in zip(row, good, numeric, strict=True) if n)
    return 2 * fits > sum(numeric) and any(good)


def _layout(
    lines: list[str],
    rows: list[list[str]],
    first: int,
    numeric: tuple[bool, ...],
    separator: str | None,
    comma: bool,
) -> TableLayout:
    """Header and units from the lines before the first row of data."""
    width = len(numeric)
    heads = _headers(lines, rows[:first], width, separator)
    if not heads:
        names = tuple(str(c + 1) for c in range(width))
        begin = [row[0] for row in rows[first:] if len(row) == width]
        timed = _rises(begin, comma)
        return TableLayout(separator, comma, first, names, (None,) * width, False, numeric, timed=timed)
    names, units = _names_and_units(heads)
    return TableLayout(separator, comma, first, names, units, True, numeric)


def _headers(lines: list[str], rows: list[list[str]], width: int, separator: str | None) -> list[list[str]]:
    """Rows of the table's width above the data; if there are none, comments that have it."""
    above = [row for row in rows if len(row) == width and any(row)]
    if above:
        return above
    comments = [
        cells(line.lstrip().lstrip("".join(COMMENTS)).strip(), separator)
        for line, row in zip(lines, rows, strict=False)
        if not row and line.lstrip().startswith(COMMENTS) and '"' not in line
    ]
    return [row for row in comments if len(row) == width]


def _names_and_units(heads: list[list[str]]) -> tuple[tuple[str, ...], tuple[str | None, ...]]:
    """Names and units of the columns from the rows above the data."""
    names: list[str] = heads[-1]
    units: list[str | None] = [None] * len(names)
    if len(heads) > 1 and _are_units(heads[-1]):
        names, units = heads[-2], [_bare(cell) for cell in heads[-1]]
    elif len(heads) > 2 and _are_units(heads[-2]):  # another row below the units
        names, units = heads[-3], [_bare(cell) for cell in heads[-2]]
    return tuple(names), tuple(unit or unit_in(name)[1] for name, unit in zip(names, units, strict=True))


def _rises(column: list[str], comma: bool) -> bool:
    """Whether the numbers of a column hardly ever fall; dates are taken to."""
    values = [number(cell, comma) for cell in column if is_number(cell, comma)]
    rising = sum(a <= b for a, b in pairwise(values))
    return len(values) < 2 or (rising >= _RISES * (len(values) - 1) and values[0] < values[-1])


def _are_units(row: list[str]) -> bool:
    """Whether most of a row's cells are names of units."""
    texts = [cell.strip("[]() ") for cell in row if cell.strip("[]() ")]
    return bool(texts) and 2 * sum(is_unit(text) or "volt" in text.lower() for text in texts) > len(texts)


def _bare(cell: str) -> str | None:
    """A unit without the brackets around it."""
    text = cell.strip()
    return (text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()") else text) or None


def is_unit(text: str) -> bool:
    """Whether this is the name of a unit of measurement."""
    return text.lower() in _OTHER_UNITS or text in RAW or any(known(text, si) for si in _QUANTITIES)


def unit_in(name: str) -> tuple[str, str | None]:
    """A column's name without the unit that it holds: `Force [kN]`, `Time (ms)`, `x_mm`, `time_ms`, `a / g`."""
    match = _IN_NAME.match(name.strip())
    if match:
        unit = (match["square"] or match["round"] or match["bare"] or "").strip()
        if unit and (is_unit(unit) or match["square"]):
            return match["name"].strip(), unit
    stem, _, last = name.strip().rpartition("_")
    if stem and last in ("s", "ms", "us", "ns", "mm", "um", "cm", "kN", "N", "g", "bar", "kPa"):
        return stem, last
    return name.strip(), None
