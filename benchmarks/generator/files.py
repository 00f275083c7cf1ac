"""Recordings as files: MCAP with JSON messages, BLF, ASC and candump logs, CSV."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import can
import cantools
import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

START = 1_790_000_000_000_000_000  # ns since the epoch
PERIOD = 10_000_000  # ns
DATABASE = Path(__file__).resolve().parents[2] / "model" / "systems" / "bogie.dbc"


def _grouped(places: tuple[dict[str, str], ...], key: str) -> dict[str, list[tuple[str, int]]]:
    """Topic or message -> [(field or signal, channel)]."""
    groups: dict[str, list[tuple[str, int]]] = {}
    for channel, place in enumerate(places):
        owner, _, name = place[key].rpartition(".")
        groups.setdefault(owner, []).append((name, channel))
    return groups


def write_mcap(path: Path, vehicle: Vehicle, values: Array, name: str, start: int = START) -> None:
    """One JSON channel per node and quantity; publish time is the sample's, log time comes a little later.

    start: ns since the epoch, of the first sample.
    """
    topics = _grouped(vehicle.places, "mcap")
    jitter = np.random.default_rng(len(values)).integers(10_000, 400_000, size=(len(values), len(topics)))
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="concealed")
        writer.add_metadata("recording", {"vehicle": name})
        channels = []
        for topic, fields in topics.items():
            schema = {"type": "object", "properties": {f: {"type": "number"} for f, _ in fields}}
            title = topic.strip("/").replace("/", ".")
            schema_id = writer.register_schema(title, "jsonschema", json.dumps(schema).encode())
            channels.append((writer.register_channel(topic, "json", schema_id), fields))
        for row, sample in enumerate(values.tolist()):
            time = start + row * PERIOD
            for column, (channel, fields) in enumerate(channels):
                data = json.dumps({f: float(f"{sample[c]:.7g}") for f, c in fields}).encode()
                writer.add_message(channel, time + int(jitter[row, column]), data, time)
        writer.finish()


def write_can(path: Path, vehicle: Vehicle, values: Array, name: str) -> None:
    """Frames of the bundled database at 10 ms; the suffix of the path chooses BLF, ASC or candump log."""
    database = cantools.database.Database()
    database.add_dbc_file(str(DATABASE))
    frames = []
    for message, signals in _grouped(vehicle.places, "can").items():
        definition = database.get_message_by_name(message)
        codes = np.zeros((len(values), 4), "<i2")
        for signal_name, channel in signals:
            signal = definition.get_signal_by_name(signal_name)
            codes[:, signal.start // 16] = np.clip(np.rint(values[:, channel] / signal.scale), -32768, 32767)
        frames.append((definition.frame_id, [row.tobytes() for row in codes]))
    with can.Logger(str(path)) as logger:
        for row in range(len(values)):
            for place, (frame_id, payloads) in enumerate(frames):
                stamp = START / 1e9 + row * 0.01 + place * 1e-4
                logger(
                    can.Message(
                        timestamp=stamp,
                        arbitration_id=frame_id,
                        data=payloads[row],
                        is_extended_id=False,
                        channel=0 if path.suffix != ".log" else "can0",
                    )
                )


def write_csv(path: Path, vehicle: Vehicle, values: Array, name: str) -> None:
    """A header of time and the channels' csv columns (needed in the system file)."""
    header = ",".join(["time", *(place["csv"] for place in vehicle.places)])
    time = np.arange(len(values))[:, None] / 100
    np.savetxt(path, np.hstack([time, values]), fmt="%.9g", delimiter=",", header=header, comments="")


WRITERS: dict[str, Callable[[Path, Vehicle, Array, str], None]] = {
    "mcap": write_mcap,
    "blf": write_can,
    "asc": write_can,
    "log": write_can,
    "csv": write_csv,
}
