"""`sprung inspect`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from sprung.model.signals import TimeColumn
from sprung.model.system import System, load_system
from sprung.model.text import escaped
from sprung.model.units import FACTORS, known
from sprung.replay.inspection import Inspection, Signal
from sprung.replay.skeleton import skeleton
from sprung.replay.whole_file import written_whole
from sprung.service.can_database import database_of
from sprung.service.cli import apart
from sprung.service.cli.console import print_table
from sprung.service.cli.targets import check_file
from sprung.service.errors import UserError
from sprung.service.sources.loading import InspectionRequest
from sprung.service.times import to_iso


def run(
    file: Path,
    *,
    system_file: Path | None,
    dbc: Path | None,
    column: str | None,
    unit: str | None,
    rate: float | None,
    write_system: Path | None,
    json_lines: bool,
) -> int:
    """Print the contents of a recording; 1 if part of it could not be read."""
    check_file(write_system)
    system = None if system_file is None else load_system(system_file)
    time, said = _time(system, column, unit, rate)
    database = dbc if system is None else database_of(system, dbc)
    found = apart.look(InspectionRequest(file, database, time))
    if write_system is not None:
        _write(write_system, skeleton(found, file.stem, said))
    if json_lines:
        print(json.dumps(as_dict(found), allow_nan=False))
    else:
        print(heading(found))  # a line of its own: a table would break it, and its path, at its width
        print_table(table(found))
        for line in remarks(found):
            print(line)
    for line in found.problems:
        print(f"sprung: {file}: {line}", file=sys.stderr)
    return int(found.incomplete)


def _time(
    system: System | None, column: str | None, unit: str | None, rate: float | None
) -> tuple[TimeColumn, dict[str, object]]:
    """The time as the system file or the options say, and what to write about it into a skeleton."""
    if system is not None:
        if (column, unit, rate) != (None, None, None):
            raise UserError("the system file says how times are read: give it, or --time-column, --time-unit, --rate")
        return system.time, system.file.time.model_dump(exclude_none=True, mode="json")
    name = known(unit, "s") if unit else None
    if unit and name not in FACTORS["s"]:
        raise UserError(f"--time-unit {unit!r}: known are {', '.join(FACTORS['s'])}")
    if rate is not None and not rate > 0:
        raise UserError(f"--rate {rate:g}: must be greater than 0")
    given = {"column": column, "unit": name, "rate": rate}
    seconds = FACTORS["s"][name] if name else None
    return TimeColumn(column, seconds, None, rate), {key: v for key, v in given.items() if v is not None}


def _write(path: Path, text: str) -> None:
    if path.exists():
        raise UserError(f"{path}: exists already; --write-system writes new files only")
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def as_dict(found: Inspection) -> dict[str, object]:
    """For machines."""
    said = asdict(found)
    start = said.pop("start")
    return {"file": said.pop("file"), "start": None if found.relative or start is None else to_iso(start), **said}


def heading(found: Inspection) -> str:
    """Which recording, how long, since when."""
    began = "times count from 0" if found.relative or found.start is None else f"begins {to_iso(found.start)}"
    return f"{escaped(found.file)}: {found.seconds:.6g} s, {began}"


def table(found: Inspection) -> Table:
    """A row for every signal."""
    out = Table()
    out.add_column("signal", overflow="fold")
    out.add_column("unit")
    for name in ("rate Hz", "range", "mean", "std", "noise", "90 % of power Hz", "peak Hz"):
        out.add_column(name, justify="right")
    for s in found.signals:
        band = "–" if s.band is None else f"{s.band[0]:.3g} to {s.band[1]:.3g}"
        numbers = [f"{v:.4g}" if v is not None else "–" for v in (s.mean, s.deviation, s.noise)]
        low_high = "–" if s.minimum is None else f"{s.minimum:.4g} to {s.maximum:.4g}"
        rate = "–" if s.rate is None else f"{s.rate:.5g}"
        peak = "–" if s.peak is None else f"{s.peak:.3g}"
        out.add_row(escaped(s.name), escaped(s.unit or "–"), rate, low_high, *numbers, band, peak)
    return out


def remarks(found: Inspection) -> list[str]:
    """One line for everything that deserves a second look."""
    return [escaped(f"{signal.name}: {remark}") for signal in found.signals for remark in _of(signal)]


def _of(s: Signal) -> list[str]:
    out = []
    if s.samples == s.missing:
        return ["no valid value"]
    if s.constant:
        return [f"always {s.minimum:g}"]
    if s.missing:
        out.append(f"{s.missing} of {s.samples} values are missing")
    if s.lost:
        out.append(f"{s.lost} samples lost of {s.samples + s.lost}")
    if s.gaps:
        out.append(f"{s.gaps} gaps, the longest of {s.longest_gap:.3g} s")
    if s.duplicate_times:
        out.append(f"{s.duplicate_times} samples at the time of the one before")
    if s.jitter is not None and s.jitter > 0.05:
        out.append(f"time stamps scatter by {s.jitter:.2g} periods about an even clock")
    if s.standstill:
        stretches = ", ".join(f"{a:.6g} to {b:.6g} s" for a, b in s.standstill[:4])
        out.append(f"stands still from {stretches}{' ...' if len(s.standstill) > 4 else ''}")
    if s.same_as:
        reversed_ = s.same_as.startswith("-")
        out.append(f"is {s.same_as.removeprefix('-')}{' with the other sign' if reversed_ else ''}")
    return out
