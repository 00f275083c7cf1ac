"""What a recording holds, without a system file: every signal of numbers as a channel that can be read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database import Database

from sprung.model.signals import ANY_TIME, Channel, TimeColumn
from sprung.model.text import some
from sprung.replay import csvtable, parquet, series
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.candatabase import load_database
from sprung.replay.frames import EXTENDED
from sprung.replay.mcapfields import Field, Topic
from sprung.replay.mcapfile import McapFile
from sprung.replay.recording import CAN_READERS, TEXT_TABLES, kind_of
from sprung.replay.tables import NAMES, Column, time_name, time_of

PROBED_BATCHES = 50  # of an MCAP file, in which its topics are looked for
MOST_CHANNELS = 2_000
MOST_ELEMENTS = 64  # of an array in a message that are listed
DEEPEST = 6
NO_TIME = (
    "no column of times is recognised, so rates are per sample and times count samples; set `time: {column: NAME}` "
    "or `time: {rate: HZ}`"
)


Named = list[tuple[str, str | None]]  # name and unit


@dataclass(frozen=True, slots=True)
class Listing:
    """The signals of a recording, with the unit that the file or the CAN database states."""

    signals: list[tuple[Channel, str | None]]
    time: TimeColumn  # with which they can be read
    notes: list[str]


def signals_of(path: Path, dbc: str | Path | Database | None = None, time: TimeColumn = ANY_TIME) -> Listing:
    """Every signal of numbers; raises UnreadableRecording."""
    extension = kind_of(path)
    notes: list[str] = []
    found: list[tuple[Channel, str | None]]
    if extension == ".mcap":
        found = [(Channel(field, "", 0.0, mcap=field), None) for field in _topics(path)]
    elif extension in CAN_READERS:
        found = _can_signals(path, dbc)
    else:
        listed, time = _columns(path, extension, time, notes)
        found = [(Channel(name, "", 0.0, column=name), unit) for name, unit in listed]
    if len(found) > MOST_CHANNELS:
        raise UnreadableRecording(f"{path}: {len(found)} signals; at most {MOST_CHANNELS} are listed")
    if not found:
        raise UnreadableRecording(f"{path}: no signals of numbers in it")
    return Listing(found, time, notes)


def _columns(path: Path, extension: str, time: TimeColumn, notes: list[str]) -> tuple[Named, TimeColumn]:
    """The columns of numbers, but for those of times, and where the times are; rows are counted when nowhere."""
    if extension in series.KINDS:
        with series.opened(path) as opened:
            columns = [column for column in opened if not column.damage]
            notes += [f"left out, since it cannot be read: {one.name} ({one.damage})" for one in opened if one.damage]
            return _series(path, _first_sheets(columns, notes), time, notes)
    if extension in TEXT_TABLES:
        layout, _ = csvtable.read_layout(path)
        names = [n if layout.names.count(n) == 1 else str(i + 1) for i, n in enumerate(layout.names)]
        times = time_name(layout.names, time, layout.timed)
        every = list(zip(names, layout.units, layout.numeric, strict=True))
        listed = [(name, unit) for name, unit, numeric in every if numeric]
        others = [name for name, _, numeric in every if not numeric]
        if others:
            notes.append(f"left out, since they hold no plain numbers: {some(others, NAMES)}")
    else:
        listed, time = parquet.listing(path, time)
        times = time_name([name for name, _ in listed], time)
    if times is None and time.rate is None:
        notes.append(NO_TIME)
        time = TimeColumn(rate=1.0)
    return [(name, unit) for name, unit in listed if name != times], time


def _first_sheets(columns: list[Column], notes: list[str]) -> list[Column]:
    """Of arrays with more than two axes, the series of the first sheet: the others look alike, often in thousands."""
    others = [column.name for column in columns if column.sheet]
    if others:
        notes.append(f"{len(others)} more series of further sheets are addressed alike: {others[0]} to {others[-1]}")
    return [column for column in columns if not column.sheet]


def _series(path: Path, columns: list[Column], time: TimeColumn, notes: list[str]) -> tuple[Named, TimeColumn]:
    """Series that have times, but for those that are times."""
    timed, others = [], []
    for column in columns:
        try:
            timed.append((column, time_of(path, column, columns, time)))
        except UnreadableRecording:
            others.append(column)
    if not timed:
        if time.name is not None:
            time_of(path, columns[0], columns, time)  # raises for an unknown name
        notes.append(NO_TIME)
        return [(column.name, column.unit) for column in columns], TimeColumn(rate=1.0)
    if others:
        lengths = ", ".join(f"{column.name} ({column.length})" for column in others[:6])
        notes.append(f"{len(others)} series without times of their length: {lengths}{' ...' if others[6:] else ''}")
    times = {id(key) for _, key in timed}
    return [(column.name, column.unit) for column, _ in timed if id(column) not in times], time


def _topics(path: Path) -> Iterator[str]:
    """`/topic.field` of every number in the first message of every topic."""
    account = Account()
    file = McapFile(path, account)
    seen: set[int] = set()
    for batch in islice(file.batches(), PROBED_BATCHES):
        for channel_id, messages in batch.items():
            if channel_id in seen or channel_id not in file.channels:
                continue
            seen.add(channel_id)
            record = file.channels[channel_id]
            topic = Topic(record, file.schemas.get(record.schema_id), [Field(0, ("",), "auto")], account)
            document = _first(topic, messages.data)
            if document is not None:
                yield from (f"{record.topic}.{field}" for field in _numbers(document))


def _first(topic: Topic, data: list[bytes]) -> Any:
    for item in data[:8] if topic.decode else ():
        try:
            return topic.decode(item) if topic.decode else None
        except Exception:  # decoders raise what their generated code happens to raise; the next message may be sound
            continue
    return None


def _numbers(item: Any, path: str = "", depth: int = 0) -> Iterator[str]:
    """The paths of numbers in a decoded message, but for its time stamps."""
    if isinstance(item, bool) or depth > DEEPEST:
        return
    if isinstance(item, (int, float)):
        yield path
        return
    if _is_array(item):
        for i, part in enumerate(islice(item, MOST_ELEMENTS)):
            yield from _numbers(part, f"{path}[{i}]", depth + 1)
        return
    for name, part in _parts(item):
        if name not in ("header", "stamp", "timestamp") or depth > 0:
            yield from _numbers(part, f"{path}.{name}" if path else name, depth + 1)


def _is_array(item: Any) -> bool:
    """A list of JSON, a repeated field of protobuf, an array of ROS."""
    return hasattr(item, "__getitem__") and hasattr(item, "__len__") and not isinstance(item, (str, bytes, dict))


def _parts(item: Any) -> list[tuple[str, Any]]:
    if isinstance(item, dict):
        return [(str(name), part) for name, part in item.items()]
    descriptor = getattr(item, "DESCRIPTOR", None)
    if descriptor is not None:
        return [(field.name, getattr(item, field.name)) for field in descriptor.fields]
    return [(name, getattr(item, name)) for name in getattr(item, "__slots__", ()) if not name.startswith("_")]


def _can_signals(path: Path, dbc: str | Path | Database | None) -> list[tuple[Channel, str | None]]:
    """Signals of the CAN database whose messages are on the bus."""
    ids: set[int] = set()
    for block in CAN_READERS[path.suffix.lower()](path, Account()):
        ids |= set(np.unique(block.id).tolist())
    database = dbc if isinstance(dbc, Database) else load_database(Path(dbc)) if dbc is not None else Database()
    found: list[tuple[Channel, str | None]] = []
    for message in database.messages:
        if (message.frame_id | (EXTENDED if message.is_extended_frame else 0)) in ids:
            for signal in message.signals:
                name = f"{message.name}.{signal.name}"
                found.append((Channel(name, "", 0.0, can=name), signal.unit))
    if not found:
        shown = ", ".join(f"0x{i & 0x1FFFFFFF:X}" for i in sorted(ids)[:12])
        raise UnreadableRecording(
            f"{path}: {len(ids)} CAN identifiers ({shown}{' ...' if len(ids) > 12 else ''}); "
            "name the CAN database with --dbc to see their signals"
        )
    return found
