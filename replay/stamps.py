"""Time stamps of tables: numbers of any unit and epoch, and written dates, as nanoseconds since 1970."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, datetime, timedelta
from fractions import Fraction
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, IntArray, TimeColumn
from sprung.replay.account import Account, UnreadableRecording

LATEST = 1 << 62  # ns, the year 2116; beyond it a stamp is damage, and sums of two would overflow
ABSOLUTE = 100_000_000  # s: a time before 1973 counts from the start of a measurement, not from 1970
_MAGNITUDES = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "us"), (1e11, 1e-3, "ms"))  # of Unix times that cannot be seconds
_WRITTEN = re.compile(
    r"^\s*(?:(?P<date>\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[T\s]+)?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,:](?P<fraction>\d{1,9})\d*)?)?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>[Zz]|UTC|GMT|[+-]\d{2}:?\d{2})?\s*$"
)
SECOND, HOUR, DAY = 10**9, 3600 * 10**9, 86_400 * 10**9  # ns


class Stamps:
    """Turns the cells of one time column into nanoseconds; `account.relative` is set if they count from a start."""

    def __init__(self, time: TimeColumn, unit: float | None, account: Account, *, zoned: bool = True) -> None:
        """`unit`: of the column by its header, s; `zoned`: dates that are no text are in UTC, not in a local time."""
        self.time = time
        self.zoned = zoned
        self.seconds = time.seconds or unit
        self.account = account
        self._first: Any = None  # the first stamp as recorded, and its ns
        self._base = 0
        self._dates: dict[str, int] = {}
        self._zone = ZoneInfo(time.zone) if time.zone else None
        self._ahead: dict[int, int] = {}  # of UTC, ns, by the local hour since 1970

    def nanoseconds(self, cells: NDArray[Any] | Sequence[str]) -> tuple[IntArray, BoolArray]:
        """Stamps and which of them are sound; the others are 0."""
        if not isinstance(cells, np.ndarray) or cells.dtype.kind in "OUS":
            return self._written(cells)
        if cells.dtype.kind == "M":
            whole = cells.astype("datetime64[ns]")
            good = ~np.isnat(whole)
            stamps = np.where(good, whole.astype(np.int64), 0)
            if not self.zoned:
                hours, place = np.unique(stamps // HOUR, return_inverse=True)
                stamps = stamps - np.array([self._local(int(hour)) for hour in hours], dtype=np.int64)[place]
            return stamps, good
        return self._counted(cells)

    def _counted(self, cells: NDArray[Any]) -> tuple[IntArray, BoolArray]:
        finite = np.isfinite(cells)
        if self._first is None:
            if not finite.any():
                return np.zeros(len(cells), dtype=np.int64), finite
            self._begin(_first_usual(cells[finite]))
        with np.errstate(invalid="ignore", over="ignore"):
            if cells.dtype.kind in "iu":
                apart = (cells.astype(np.int64) - np.int64(self._first)).astype(np.float64)
            else:
                apart = cells.astype(np.float64) - float(self._first)
            elapsed = np.rint(apart * (float(self.seconds or 1.0) * SECOND))
            good = finite & (np.abs(elapsed) < LATEST) & (np.abs(elapsed + float(self._base)) < LATEST)
        return np.where(good, elapsed, 0).astype(np.int64) + np.where(good, self._base, 0), good

    def _begin(self, first: Any) -> None:
        """Choose unit and epoch by the first stamp."""
        self._first = first.item()
        size = abs(float(self._first))
        if self.seconds is None:
            self.seconds = 1.0
            if self.time.epoch is None:
                for least, seconds, name in _MAGNITUDES:
                    if size > least:
                        self.seconds = seconds
                        self.account.note(f"times of this size are interpreted as {name} since 1970")
                        break
        exact = Fraction(self._first) * Fraction(self.seconds).limit_denominator(10**9)
        self._base = round(exact * SECOND) + (self.time.epoch or 0)
        self.account.relative = self.time.epoch is None and abs(self._base) < ABSOLUTE * SECOND
        if abs(self._base) >= LATEST:
            raise UnreadableRecording(
                f"the first time stamp, {first}, lies beyond the year 2116; set `time: {{unit: ..., epoch: ...}}` "
                "in the system file"
            )

    def _written(self, cells: Sequence[Any] | NDArray[Any]) -> tuple[IntArray, BoolArray]:
        instants = (self._instant(str(cell)) for cell in cells)
        stamps = [None if instant is None or abs(instant) >= LATEST else instant for instant in instants]
        good = np.array([stamp is not None for stamp in stamps], dtype=bool)
        return np.array([stamp or 0 for stamp in stamps], dtype=np.int64), good

    def _instant(self, cell: str) -> int | None:
        """A written date and time; a time of day alone counts from midnight."""
        match = _WRITTEN.match(cell)
        if match is None:
            return None
        hour = int(match["hour"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].lower() == "pm" else 0)
        minute, second = int(match["minute"]), int(match["second"] or 0)
        if hour > 24 or minute > 59 or second > 60:
            return None
        fraction = int((match["fraction"] or "0").ljust(9, "0"))
        of_day = (hour * 3600 + minute * 60 + second) * SECOND + fraction
        if match["date"] is None:
            self.account.relative = self.time.epoch is None
            return of_day + (self.time.epoch or 0)
        if match["date"] not in self._dates:
            day = self._day(match["date"], bool(match["half"]))
            if day is None:
                return None
            self._dates[match["date"]] = day
        local = self._dates[match["date"]] * DAY + of_day
        zone = match["zone"]
        if zone is None:
            return local - self._local(local // HOUR)
        if zone[0] in "+-":
            return local - (int(zone[1:3]) * HOUR + int(zone[-2:]) * 60 * SECOND) * (1 if zone[0] == "+" else -1)
        return local

    def _local(self, hour: int) -> int:
        """How far dates without a zone are ahead of UTC, ns; an hour that a zone has twice is the first one."""
        if self._zone is None:
            self.account.note(
                "its dates state no time zone and are taken as UTC; if they are local times, write "
                "`time: {zone: Europe/Berlin}` into the system file (`zone: UTC` if not)"
            )
            return 0
        if hour not in self._ahead:
            offset = (datetime(1970, 1, 1, tzinfo=self._zone) + timedelta(hours=hour)).utcoffset()
            self._ahead[hour] = 0 if offset is None else round(offset.total_seconds()) * SECOND
        return self._ahead[hour]

    def _day(self, text: str, american: bool) -> int | None:
        """Days since 1970."""
        separator = next(c for c in text if c in "-/.")
        parts = text.split(separator)
        if len(parts) != 3:
            return None
        if len(parts[0]) == 4:
            year, month, day = map(int, parts)
        else:
            first, second, year = map(int, parts)
            american = separator == "/" and (american or second > 12) and first <= 12
            month, day = (first, second) if american else (second, first)
            if separator == "/" and first <= 12 and second <= 12 and first != second and not self._dates:
                self.account.note(f"{text} is read as {'month/day' if american else 'day/month'}/year")
        try:
            return (date(year, month, day) - date(1970, 1, 1)).days
        except ValueError:
            return None


def _first_usual(stamps: NDArray[Any]) -> Any:
    """The first stamp that is of the same kind as most: a logger's first one may be 0, or anything else."""

    def kind(stamp: Any) -> tuple[str, bool, bool]:
        size = abs(float(stamp))
        unit = next((name for least, _, name in _MAGNITUDES if size > least), "s")
        return unit, size < ABSOLUTE, stamp < 0

    usual = kind(np.sort(stamps)[len(stamps) // 2])
    return next(stamp for stamp in stamps if kind(stamp) == usual)


def is_written(cell: str) -> bool:
    """Whether a cell holds a date or a time of day."""
    return _WRITTEN.match(cell) is not None
