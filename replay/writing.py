"""Recordings written: samples of a system's channels in the formats that readers know."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import can
import numpy as np
from cantools.database.can import Database, Message
from mcap.writer import Writer

from sprung.model.signals import Channel, FloatArray
from sprung.replay.candatabase import load_database
from sprung.replay.whole_file import written_whole


class UnwritableRecording(ValueError):
    """A recording that cannot be written as asked for; one line."""


def write_recording(
    path: str | Path,
    channels: Sequence[Channel],
    values: FloatArray,
    sample_rate: float,
    start: int,
    *,
    dbc: str | Path | None = None,
    vehicle: str | None = None,
) -> None:
    """Write values (T, C), SI, sampled evenly from `start` (ns since the epoch), in the format of the path.

    Scale, offset, sign and unit of the addresses are undone, so that reading gives the same values again.  NaN is
    left out.  CAN formats need the database; signals are rounded to its steps and cut to its range.
    Errors: `UnwritableRecording`.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise UnwritableRecording(f"{path}: cannot write files of this kind; known are {' '.join(sorted(WRITERS))}")
    recorded = (values - [c.offset for c in channels]) / [c.gain for c in channels]
    times = start + np.round(np.arange(len(values)) * 1e9 / sample_rate).astype(np.int64)
    try:
        with written_whole(path) as part:  # which would be read as a whole ride
            writer(part, channels, recorded, times, dbc, vehicle)
    except OSError as error:
        raise UnwritableRecording(f"{path}: {error.strerror}") from error


def without_address(path: Path, channel: Channel) -> str | None:
    """The kind of address that a channel lacks to be written into a file of this kind; None where it has all."""
    key = {".csv": None, ".mcap": "mcap"}.get(path.suffix.lower(), "can")
    return None if key is None or getattr(channel, key) is not None else key


def _csv(
    path: Path, channels: Sequence[Channel], values: FloatArray, times: np.ndarray, dbc: object, vehicle: str | None
) -> None:
    names = [c.csv or c.column or c.name for c in channels]
    with path.open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(["time", *names])
        for time, row in zip(times.tolist(), values.tolist(), strict=True):
            cells = ["" if math.isnan(value) else f"{value:.10g}" for value in row]
            table.writerow([f"{time // 10**9}.{time % 10**9:09d}", *cells])


def _mcap(
    path: Path, channels: Sequence[Channel], values: FloatArray, times: np.ndarray, dbc: object, vehicle: str | None
) -> None:
    topics = _grouped(path, channels, "mcap")
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="sprung")
        if vehicle is not None:
            writer.add_metadata("recording", {"vehicle": vehicle})
        ids = {}
        for topic, fields in topics.items():
            schema = {"type": "object", "properties": {field: {"type": "number"} for field, _ in fields}}
            title = topic.strip("/").replace("/", ".")
            known = writer.register_schema(title, "jsonschema", json.dumps(schema).encode())
            ids[topic] = writer.register_channel(topic, "json", known)
        for time, row in zip(times.tolist(), values.tolist(), strict=True):
            for topic, fields in topics.items():
                document = {field: row[column] for field, column in fields if not math.isnan(row[column])}
                writer.add_message(ids[topic], log_time=time, data=json.dumps(document).encode(), publish_time=time)
        writer.finish()


def _can(
    path: Path,
    channels: Sequence[Channel],
    values: FloatArray,
    times: np.ndarray,
    dbc: str | Path | None,
    vehicle: str | None,
) -> None:
    if dbc is None:
        raise UnwritableRecording(f"{path}: a CAN database is needed to write frames; give --dbc")
    database = load_database(Path(dbc), strict=True)
    messages = [(_message(database, name), fields) for name, fields in _grouped(path, channels, "can").items()]
    bus = "can0" if path.suffix == ".log" else 0
    with can.Logger(str(path)) as logger:
        for time, row in zip(times.tolist(), values.tolist(), strict=True):
            for message, fields in messages:
                frame = {signal.name: signal.initial or 0 for signal in message.signals}
                frame |= {name: _within(message, name, row[column]) for name, column in fields}
                logger(
                    can.Message(
                        timestamp=time / 1e9,
                        arbitration_id=message.frame_id,
                        data=message.encode(frame, strict=False),
                        is_extended_id=message.is_extended_frame,
                        channel=bus,
                    )
                )


def _message(database: Database, name: str) -> Message:
    try:
        return database.get_message_by_name(name)
    except KeyError:
        raise UnwritableRecording(f"the CAN database has no message {name!r}") from None


def _within(message: Message, name: str, value: float) -> float:
    """The value that the signal's bits can hold nearest to `value`; 0 for one that is missing."""
    signal = message.get_signal_by_name(name)
    lowest = -(2 ** (signal.length - 1)) if signal.is_signed else 0
    highest = lowest + 2**signal.length - 1
    if signal.is_float:
        return float(np.nan_to_num(value))
    raw = round(float(np.clip((np.nan_to_num(value) - signal.offset) / signal.scale, lowest, highest)))
    return raw * signal.scale + signal.offset


def _grouped(path: Path, channels: Iterable[Channel], key: str) -> dict[str, list[tuple[str, int]]]:
    """Topic or message to [(field or signal, column)]."""
    groups: dict[str, list[tuple[str, int]]] = {}
    for column, channel in enumerate(channels):
        place = getattr(channel, key)
        if place is None:
            raise UnwritableRecording(f"{path}: {channel.name} has no `{key}` address in the system file")
        owner, _, name = place.rpartition(".")
        groups.setdefault(owner, []).append((name, column))
    return groups


_Writer = Callable[
    [Path, Sequence[Channel], FloatArray, np.ndarray, "str | Path | None", "str | None"],
    None,
]
WRITERS: dict[str, _Writer] = {".csv": _csv, ".mcap": _mcap, ".blf": _can, ".asc": _can, ".log": _can}
