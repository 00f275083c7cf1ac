"""Universal File Format, dataset 58 (functions at nodal degrees of freedom), text and binary (58b): time responses.

Layout: https://www.ceas3.uc.edu/sdrluff/ (Structural Dynamics Research Laboratory, University of Cincinnati), datasets
58 and 58b; units: dataset 164.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sprung.replay.account import UnreadableRecording
from sprung.replay.stamps import SECOND
from sprung.replay.tables import Column, EvenTimes, lost, whole

BORDER = b"    -1"
TIME_RESPONSE, TIME = 1, 17  # function type; specific data type of the abscissa
KINDS = {2: ("f4", 1), 4: ("f8", 1), 5: ("f4", 2), 6: ("f8", 2)}  # ordinate: type, numbers per value
MOST_DAMAGED = 20  # damaged datasets that are reported one by one
DIRECTIONS = {0: "", 1: "+X", -1: "-X", 2: "+Y", -2: "-Y", 3: "+Z", -3: "-Z"}
DIRECTIONS |= {4: "+RX", -4: "-RX", 5: "+RY", -5: "-RY", 6: "+RZ", -6: "-RZ"}
_DATES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%d-%b-%y", "%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S")


@dataclass(frozen=True, slots=True)
class _Function:
    """One dataset 58."""

    title: str
    place: str  # node and direction
    unit: str | None
    clock: EvenTimes | None  # None: uneven, `times` holds them
    times: NDArray[np.float64] | None  # s
    values: NDArray[np.float64]
    lacking: int  # values that are stated and not there, or are no numbers


def columns(path: Path) -> list[Column]:
    """The time responses of a file, named by node and direction (`12+Z`), else by their first line of text."""
    data = path.read_bytes()
    if BORDER not in data[:4096]:
        raise UnreadableRecording(f"{path}: not a universal file (no '    -1' line at its beginning)")
    found = list(_datasets(data))
    functions = [one for one in found if isinstance(one, _Function)]
    damaged = [(number, str(one)) for number, one in enumerate(found, 1) if isinstance(one, ValueError)]
    if not functions and damaged:
        raise UnreadableRecording(f"{path}: a damaged dataset 58: {damaged[0][1]}")
    if not functions:
        raise UnreadableRecording(f"{path}: no time responses (dataset 58, function type 1) in it")
    places, titles = Counter(f.place for f in functions), Counter(f.title for f in functions)
    out = [lost(f"dataset 58, number {number} of {len(found)},", why) for number, why in damaged[:MOST_DAMAGED]]
    for i, f in enumerate(functions):
        name = f.place if f.place and places[f.place] == 1 else f.title
        if not name or (name == f.title and titles[f.title] > 1):
            name = f"{f.place or f.title or 'response'} #{i + 1}"
        if f.times is None:
            out.append(replace(whole(name, f.values, f.unit, f.clock), lacking=f.lacking))
        else:
            value = whole(f"{name}/value", f.values, f.unit)
            out += [whole(f"{name}/time", f.times, "s"), replace(value, lacking=f.lacking)]
    return out


def _datasets(data: bytes) -> Iterator[_Function | ValueError | None]:
    """Every dataset 58 of a file, or why it cannot be read; other datasets are passed over."""
    at = 0
    while (start := _border(data, at)) is not None:
        head, at = _line(data, start)
        kind = head[:6].split()
        if not kind or kind[0] not in (b"58", b"58b"):
            end = _border(data, at)
            at = len(data) if end is None else end
            continue
        begins = at
        try:
            function, at = _dataset(data, head, at)
        except (ValueError, IndexError, OverflowError) as error:  # it costs itself
            yield ValueError(str(error))
            at = begins
        else:
            yield function
        end = _border(data, at)
        at = len(data) if end is None else end


def _dataset(data: bytes, head: bytes, at: int) -> tuple[_Function | None, int]:
    """The dataset 58 that begins at a byte, after its first line `head`, and where its values end."""
    lines: list[bytes] = []
    for _ in range(11):
        line, at = _line(data, at)
        lines.append(line)
    if head[6:7].lower() == b"b" or head[:6].split()[0] == b"58b":
        size = int(head[31:43])
        if size < 0:
            raise ValueError(f"it states {size} bytes")
        body, at = data[at : at + size], at + size
        order = "<" if int(head[7:13]) == 1 else ">"
        if int(head[13:19]) != 2:
            raise ValueError("its numbers are not in IEEE 754")
        return _function(lines, _binary(lines, body, order)), at
    end = _border(data, at)
    last = len(data) if end is None else data.rindex(BORDER, at, end)
    return _function(lines, _text(lines, data[at:last])), last


def _border(data: bytes, at: int) -> int | None:
    """The byte after the next line that holds nothing but -1."""
    while (found := data.find(BORDER, at)) >= 0:
        line, after = _line(data, found)
        if line.strip() == b"-1" and (found == 0 or data[found - 1 : found] in (b"\n", b"\r")):
            return after
        at = found + len(BORDER)
    return None


def _line(data: bytes, at: int) -> tuple[bytes, int]:
    end = data.find(b"\n", at)
    end = len(data) if end < 0 else end
    return data[at:end].rstrip(b"\r"), end + 1


def _text(lines: list[bytes], body: bytes) -> NDArray[np.float64]:
    """Numbers of fixed width (two of them may touch: -1.0E+00-2.0E+00)."""
    kind, _, even = _shape(lines)
    widths = {("f4", True): [13], ("f8", True): [20], ("f4", False): [13], ("f8", False): [13, 20]}
    pattern = widths[KINDS[kind][0], even]
    out = []
    for line in body.splitlines():
        at = turn = 0
        while line[at:].strip():
            width = pattern[turn % len(pattern)]
            try:
                out.append(float(line[at : at + width].replace(b"D", b"E")))
            except ValueError:  # it costs itself: the file may end within a number
                out.append(math.nan)
            at, turn = at + width, turn + 1
    return np.array(out)


def _binary(lines: list[bytes], body: bytes, order: str) -> NDArray[np.float64]:
    kind, count, even = _shape(lines)
    letter, per = KINDS[kind]
    if even or letter == "f4":
        return np.frombuffer(body[: len(body) // int(letter[1]) * int(letter[1])], dtype=order + letter).astype(float)
    pair = np.dtype([("x", order + "f4"), ("y", order + letter, (per,))])
    pairs = np.frombuffer(body[: count * pair.itemsize], dtype=pair)
    return np.column_stack([pairs["x"].astype(float), pairs["y"]]).reshape(-1)


def _shape(lines: list[bytes]) -> tuple[int, int, bool]:
    """Kind of the ordinate, number of values, and whether the abscissa is even."""
    record = lines[6]
    kind, count, even = int(record[:10]), int(record[10:20]), int(record[20:30]) == 1
    if count < 0:
        raise ValueError(f"it states {count} values")
    if kind not in KINDS:
        raise ValueError(f"unknown kind of data {kind}")
    return kind, count, even


def _function(lines: list[bytes], numbers: NDArray[np.float64]) -> _Function | None:
    """A time response; None for spectra, frequency responses and complex functions."""
    kind, count, even = _shape(lines)
    text = [line.decode("latin-1") for line in lines]
    if not _is_time_response(text, kind):
        return None
    title, place, unit = _or_none(text[0].strip()) or "", _place(text[5]), _or_none(text[8][47:67].strip())
    if even:
        lacking = count - np.isfinite(numbers[:count]).sum()
        return _Function(title, place, unit, _even_times(text), None, numbers[:count], int(lacking))
    pairs = numbers[: min(2 * count, len(numbers) // 2 * 2)].reshape(-1, 2)
    lacking = count - np.isfinite(pairs).all(axis=1).sum()
    return _Function(title, place, unit, None, pairs[:, 0], pairs[:, 1], int(lacking))


def _is_time_response(text: list[str], kind: int) -> bool:
    """Whether the function is real and over time, as far as its header states that."""
    function, abscissa = int(text[5][:5] or 0), int(text[7][:10] or 0)
    return function in (0, TIME_RESPONSE) and abscissa in (0, TIME) and KINDS[kind][1] == 1


def _place(line: str) -> str:
    """Node and direction of the response, `12+Z`."""
    node, direction = int(line[41:51] or 0), int(line[51:55] or 0)
    return f"{node}{DIRECTIONS.get(direction, '')}" if node else ""


def _even_times(text: list[str]) -> EvenTimes:
    """The clock of evenly spaced values."""
    first, step = float(text[6][30:43] or 0), float(text[6][43:56] or 0)
    if not step > 0:
        raise ValueError("its time step is not positive")
    began = _instant(text[2])
    return EvenTimes((began or 0) + round(first * SECOND), step, began is None)


def _or_none(word: str) -> str | None:
    """A word of the header, in which NONE stands for none."""
    return None if word.upper() in ("", "NONE") else word


def _instant(text: str) -> int | None:
    """The date in the third line, ns since 1970."""
    for form in _DATES:
        try:
            return int(datetime.strptime(text.strip(), form).replace(tzinfo=UTC).timestamp()) * SECOND
        except ValueError:
            continue
    return None
