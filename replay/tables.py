"""What all tabular files share: finding columns and the time, and putting columns into blocks of samples."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, Channel, FloatArray, IntArray, SampleBlock, TimeColumn
from sprung.model.text import some
from sprung.model.units import FACTORS, known
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.bounds import check_samples
from sprung.replay.csvlayout import number, unit_in
from sprung.replay.multirate import MultirateColumns
from sprung.replay.stamps import LATEST, SECOND, Stamps, is_written
from sprung.replay.statedunits import compare_units

ROWS = 16_384  # that are handed out together
MOST_COLUMNS = 10_000
NAMES = 12  # that an error lists
TIME_NAMES = (
    *("time", "t", "timestamp", "timestamps", "time stamp", "datetime", "date time", "date/time", "seconds", "secs"),
    *("sec", "elapsed time", "elapsed", "zeit", "zeitstempel", "temps", "tempo", "tiempo", "x_time", "rel time"),
    *("time_s", "t_s", "epoch", "unix time", "utc", "stamp", "ts", "abs time", "date & time", "datum/uhrzeit"),
    *("datum uhrzeit", "x_value", "x value", "uhrzeit", "date", "datum"),
)


@dataclass(frozen=True, slots=True)
class EvenTimes:
    """Even times that a file states for a column by itself."""

    start: int  # ns since the Unix epoch, or from the start of the measurement
    step: float  # s
    relative: bool


@dataclass(frozen=True, slots=True)
class Column:
    """One series of a file that holds whole series."""

    name: str
    length: int
    read: Callable[[int, int], NDArray[Any]]  # rows a to b
    unit: str | None = None
    clock: EvenTimes | None = None
    sheet: int = 0  # of an array with more than two axes, from 0
    lacking: int = 0  # values that the file states and does not hold, or that are no numbers
    damage: str = ""  # why it cannot be read at all, though others can; it has no values then

    @property
    def group(self) -> str:
        """What stands before the last part of its name."""
        cut = max(self.name.rfind("/"), self.name.rfind("."))
        return self.name[: cut + 1]


def lost(name: str, damage: str) -> Column:
    """A column that cannot be read."""
    return replace(whole(name, np.zeros(0)), damage=damage)


def whole(name: str, values: NDArray[Any], unit: str | None = None, clock: EvenTimes | None = None) -> Column:
    """A column whose values (T,) are in memory."""
    return Column(name, len(values), lambda a, b: values[a:b], unit, clock)


def time_name(names: Sequence[str], time: TimeColumn, timed: bool = False) -> str | None:
    """The column that holds the time; None when there is none.

    timed: whether the first one does, of a table without a header.
    """
    if time.name is not None or time.rate is not None:
        return time.name
    if timed:
        return names[0]
    plain = {unit_in(name)[0].strip().lower().replace("-", " "): name for name in reversed(names)}
    plain |= {name.strip().lower(): name for name in reversed(names)}
    return next((plain[word] for word in TIME_NAMES if word in plain), None)


def position(name: str, names: Sequence[str]) -> int | None:
    """Where a column is: by its name, else by its number from 1; raises UnreadableRecording when two have the name."""
    count = names.count(name) if isinstance(names, (list, tuple)) else 0
    if count > 1:
        at = [str(i + 1) for i, other in enumerate(names) if other == name]
        raise UnreadableRecording(
            f"{count} columns are called {name!r}; select one by its number: `column: {at[0]}` or {', '.join(at[1:])}"
        )
    if count:
        return names.index(name)
    if name.isascii() and name.isdigit() and 1 <= int(name) <= len(names):
        return int(name) - 1
    return None


def find_columns(
    path: Path, names: Sequence[str], channels: Sequence[Channel], account: Account, *, csv: bool = False
) -> list[tuple[int, int]]:
    """(channel, column) of every channel that the table has.

    If the system file names no columns at all, columns are matched to the names of its channels.
    Errors: `UnreadableRecording` if none is found, or if a name resembles that of an unused column.
    """
    found: list[tuple[int, int]] = []
    lacking: list[tuple[int, str]] = []
    for place, name in _wanted_columns(path, names, channels, csv=csv):
        try:
            at = position(name, list(names))
        except UnreadableRecording as error:
            raise UnreadableRecording(f"{path}: {error}") from None
        found.append((place, at)) if at is not None else lacking.append((place, name))
    used = {at for _, at in found}
    unused = [name for i, name in enumerate(names) if i not in used]
    similar = {name: difflib.get_close_matches(name, unused, n=3, cutoff=0.6) for _, name in lacking}
    if not found or any(similar.values()):
        order = sorted(similar.items(), key=lambda item: not item[1])  # those with a suggestion first
        hints = some([_hint(name, close) for name, close in order], NAMES, "; ")
        raise UnreadableRecording(f"{path}: columns not found: {hints}; its columns: {some(names, NAMES)}")
    for place, name in lacking:
        account.note(f"no column {name!r} for {channels[place].name}")
    return found


def _wanted_columns(
    path: Path, names: Sequence[str], channels: Sequence[Channel], *, csv: bool
) -> list[tuple[int, str]]:
    """(channel, name of its column).  Errors: `UnreadableRecording` if the system file names no columns."""
    wanted = [(i, (c.csv or c.column) if csv else (c.column or c.csv)) for i, c in enumerate(channels)]
    named = [(place, name) for place, name in wanted if name]
    if not named:  # tables of `sprung simulate` are headed by the names of the channels
        named = [(place, channel.name) for place, channel in enumerate(channels) if channel.name in names]
    if not named:
        key = "`csv: name`" if csv else "`column: name`"
        raise UnreadableRecording(
            f"{path}: the system file names no columns; give its channels {key}, or name another system file (--system)"
        )
    return named


def _hint(name: str, similar: list[str]) -> str:
    """A missing column with similar ones."""
    return f"{name!r} (did you mean {some([repr(n) for n in similar], NAMES, ' or ')}?)" if similar else repr(name)


def no_time(path: Path, names: Sequence[str], time: TimeColumn) -> UnreadableRecording:
    """The error of a table whose time cannot be found."""
    if time.name is not None:
        near = difflib.get_close_matches(time.name, list(names), n=1, cutoff=0.5)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        return UnreadableRecording(f"{path}: no time column {time.name!r}{hint}; its columns: {some(names, NAMES)}")
    return UnreadableRecording(
        f"{path}: no column of times is recognised; set `time: {{column: NAME, unit: s}}` or "
        f"`time: {{rate: HZ}}` in the system file; its columns: {some(names, NAMES)}"
    )


def seconds_of(unit: str | None) -> float | None:
    """A unit of time, s; None when it is none."""
    name = known(unit, "s") if unit else None
    return FACTORS["s"].get(name) if name else None


class Rows:
    """A table that comes row by row: its time and the columns that are wanted."""

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        units: Sequence[str | None],
        channels: Sequence[Channel],
        time: TimeColumn,
        account: Account,
        *,
        timed: bool = False,
        csv: bool = False,
        zoned: bool = True,
    ) -> None:
        """timed: its first column is the time; zoned: dates that are no text are in UTC."""
        if len(names) > MOST_COLUMNS:
            raise UnreadableRecording(f"{path}: {len(names)} columns; at most {MOST_COLUMNS} are read")
        for name in names:
            account.contents[name] = 0
        self.account, self.rate = account, time.rate
        self.time: int | None = None
        if time.rate is None:
            named = time_name(names, time, timed)
            try:
                self.time = None if named is None else position(named, list(names))
            except UnreadableRecording as error:
                raise UnreadableRecording(f"{path}: {error}") from None
            if self.time is None:
                raise no_time(path, names, time)
        found = find_columns(path, names, channels, account, csv=csv)
        compare_units(((channels[place], names[at], units[at]) for place, at in found), account)
        self.columns = [column for _, column in found]
        self._index = np.array([place for place, _ in found], dtype=np.int32)
        unit = None if self.time is None else seconds_of(units[self.time])
        self._stamps = Stamps(time, unit, account, zoned=zoned)
        self._rows = 0
        self._slower = MultirateColumns()
        if self.time is None:
            account.relative = True

    def block(self, times: NDArray[Any] | Sequence[str] | None, values: FloatArray) -> SampleBlock:
        """Rows (n, columns) with their times; None: by the sample rate."""
        if times is None:
            stamps: IntArray = np.rint((self._rows + np.arange(len(values))) * (SECOND / float(self.rate or 1))).astype(
                np.int64
            )
            good = np.ones(len(values), dtype=bool)
        else:
            stamps, good = self._stamps.nanoseconds(times)
        self._rows += len(values)
        self.account.corrupt(int((~good).sum()), "row without a time")
        stamps, values = stamps[good], values[good]
        empty = np.isnan(values)
        self.account.drop(int(empty.all(axis=1).sum()), "no valid value")
        self.account.tally.used += int((~empty.all(axis=1)).sum())
        kept, missing = self._slower.kept(stamps, empty)
        self.account.values["empty or NaN"] += missing
        return _samples(stamps, self._index, values, kept)


def column_blocks(
    path: Path, columns: Sequence[Column], channels: Sequence[Channel], time: TimeColumn, account: Account
) -> Iterator[SampleBlock]:
    """Blocks of a file of whole series, which may have times of their own; in time order across them."""
    for column in columns:
        if column.damage:
            account.problem(f"{column.name} cannot be read: {column.damage}")
    columns = [column for column in columns if not column.damage]
    names = [column.name for column in columns]
    for column in columns:
        account.contents[column.name] = column.length
        if column.lacking:
            account.problem(f"{column.name}: {column.lacking} of its values are not there, or are no numbers")
    found = find_columns(path, names, channels, account)
    compare_units(((channels[place], names[at], _unit_of(columns[at])) for place, at in found), account)
    check_samples(path, sum(columns[at].length for _, at in found))
    by_time: dict[Any, list[tuple[int, Column]]] = {}
    for place, at in found:
        of_time = time_of(path, columns[at], columns, time)
        by_time.setdefault((of_time, columns[at].length), []).append((place, columns[at]))
    series = [_Series(of_time, members, time, account) for (of_time, _), members in by_time.items()]
    while any(one.more() for one in series):
        waiting = [one for one in series if one.more()]
        horizon = min(one.last for one in waiting)
        parts = [part for one in waiting for part in one.until(horizon)]
        block = SampleBlock(
            np.concatenate([part.time for part in parts]),
            np.concatenate([part.channel for part in parts]),
            np.concatenate([part.value for part in parts]),
        )
        order = np.argsort(block.time, kind="stable") if len(waiting) > 1 else slice(None)
        yield SampleBlock(block.time[order], block.channel[order], block.value[order])


def _unit_of(column: Column) -> str | None:
    """The unit that a column states, by itself or in its name."""
    return column.unit or unit_in(column.name.rsplit("/", 1)[-1])[1]


def time_of(path: Path, column: Column, columns: Sequence[Column], time: TimeColumn) -> Column | EvenTimes:
    """The times of a column: by the system file, else a time column of its length, else its own clock.

    Time columns of the column's own group come first.  Errors: `UnreadableRecording` if there are no times.
    """
    if time.rate is not None:
        return EvenTimes(0, 1.0 / time.rate, True)
    if column.clock is not None and time.name is None:
        return column.clock
    names = [one.name for one in columns if one.length == column.length]
    chosen = _time_by_name(column, names, time) if time.name is not None else _time_by_kind(column, names, time)
    if chosen is not None:
        return next(one for one in columns if one.name == chosen)
    other = next((one for one in columns if one.name == time.name), None)
    if other is not None:
        raise UnreadableRecording(
            f"{path}: {column.name} has {column.length} values, its time {time.name} has {other.length}"
        )
    if column.clock is not None:
        return column.clock
    raise no_time(path, [one.name for one in columns], time)


def _time_by_name(column: Column, names: list[str], time: TimeColumn) -> str | None:
    """The time column that the system file names, of the column's group or of the whole file."""
    assert time.name is not None
    return next((name for name in (column.group + time.name, time.name) if name in names), None)


def _time_by_kind(column: Column, names: list[str], time: TimeColumn) -> str | None:
    """A time column that is recognised by its name, of the column's group or of the whole file."""
    group = [name for name in names if name.startswith(column.group) and "/" not in name[len(column.group) :]]
    for candidates in (group, names):
        short = {name.rsplit("/", 1)[-1].rsplit(".", 1)[-1]: name for name in candidates}
        chosen = short.get(time_name(list(short), time) or "")
        if chosen:
            return chosen
    return None


class _Series:
    """Columns that share their times, read piece by piece."""

    def __init__(
        self, time: Column | EvenTimes, members: list[tuple[int, Column]], key: TimeColumn, account: Account
    ) -> None:
        self.time, self.members, self.account = time, members, account
        self.length = members[0][1].length
        unit = None
        if isinstance(time, Column):
            unit = seconds_of(time.unit) or seconds_of(_unit_of(time))
        self._stamps = Stamps(key, unit, account)
        self._slower = MultirateColumns()
        self._epoch = key.epoch or 0
        self._at = 0
        self._wrong: Counter[str] = Counter()  # values of each column that are no numbers
        self._held: list[SampleBlock] = []
        if isinstance(time, EvenTimes):
            account.relative = account.relative or (time.relative and key.epoch is None)

    def more(self) -> bool:
        """Whether something is left; reads on when nothing is held."""
        while not self._held and self._at < self.length:
            block = self._read()
            if len(block.time):
                self._held = [block]
        return bool(self._held)

    @property
    def last(self) -> int:
        """The latest time that is held."""
        return int(self._held[0].time.max())

    def until(self, horizon: int) -> list[SampleBlock]:
        """What is held up to a time."""
        block = self._held[0]
        now = block.time <= horizon
        if now.all():
            self._held = []
            return [block]
        self._held = [SampleBlock(block.time[~now], block.channel[~now], block.value[~now])]
        return [SampleBlock(block.time[now], block.channel[now], block.value[now])]

    def _read(self) -> SampleBlock:
        a, b = self._at, min(self._at + ROWS, self.length)
        self._at = b
        if isinstance(self.time, EvenTimes):
            start = self.time.start + (self._epoch if self.time.relative else 0)
            elapsed = np.rint(np.arange(a, b) * (self.time.step * SECOND))
            good = np.abs(elapsed + float(start)) < LATEST  # False for NaN
            stamps = np.where(good, elapsed, 0).astype(np.int64) + (start if good.any() else 0)
        else:
            cells = self.time.read(a, b)
            if cells.dtype.kind in "OUS" and not any(is_written(str(cell)) for cell in cells):
                cells = floats(cells)[0]
            stamps, good = self._stamps.nanoseconds(cells)
        self.account.corrupt(int((~good).sum()), "row without a time")
        read = [floats(c.read(a, b)) for _, c in self.members]
        for (_, column), (_, wrong) in zip(self.members, read, strict=True):
            self._wrong[column.name] += wrong
        if b == self.length:
            for name, wrong in (+self._wrong).items():
                self.account.problem(f"{name}: {wrong} of its values are no numbers, and taken as missing")
        values = np.stack([numbers for numbers, _ in read], axis=1)[good]
        empty = np.isnan(values)
        self.account.drop(int(empty.all(axis=1).sum()), "no valid value")
        self.account.tally.used += int((~empty.all(axis=1)).sum())
        kept, missing = self._slower.kept(stamps[good], empty)
        self.account.values["empty or NaN"] += missing
        return _samples(stamps[good], np.array([place for place, _ in self.members], dtype=np.int32), values, kept)


def floats(values: NDArray[Any]) -> tuple[FloatArray, int]:
    """Values (T,) as floats, NaN for what is no number, and how many of those there are; None is merely missing."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float64, copy=False), 0
    out = np.full(len(values), np.nan)
    if values.dtype.kind not in "OUS":  # times, complex numbers, records
        return out, len(values)
    wrong = 0
    for row, cell in enumerate(values):
        try:
            if isinstance(cell, str | bytes):
                out[row] = number(cell.decode("latin-1") if isinstance(cell, bytes) else cell, False)
            elif cell is not None:
                out[row] = float(cell)
        except (TypeError, ValueError):
            wrong += 1
        except OverflowError:  # an integer beyond all floats: missing, as those beyond what is plausible
            pass
    return out, wrong


def _samples(time: IntArray, index: NDArray[np.int32], values: FloatArray, kept: BoolArray) -> SampleBlock:
    """Values (n, columns) row by row; index: of their channels; kept: which of them are samples."""
    one_by_one = kept.reshape(-1)
    return SampleBlock(
        np.repeat(time, len(index))[one_by_one],
        np.tile(index, len(values))[one_by_one],
        values.reshape(-1)[one_by_one],
    )
