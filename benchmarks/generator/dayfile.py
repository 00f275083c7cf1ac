"""A working day as a recording, with its truth beside it."""

from __future__ import annotations

import datetime as dt
import json
import struct
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from sprung.benchmarks.generator.files import DATABASE, PERIOD, START, _grouped
from sprung.benchmarks.generator.running import SAMPLED, run_day
from sprung.benchmarks.generator.timetable import Service, Timetable, draw_timetable
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

FILES = ("blf", "mcap")
SLOW = 10  # samples between two messages on how the vehicle runs
EMPTY_PRESSURE = 4.2e5  # Pa, of air springs under the empty car
RUNNING = {  # of the bus message and topic on how the vehicle runs: noise of one value
    "speed": 0.05,  # m/s
    "yaw_rate": 5e-4,  # rad/s
    "temperature": 0.3,  # degC
    "pressure": 1e3,  # Pa
}
TOPIC, MESSAGE = "/running", "Running"


def running_values(timetable: Timetable, time: Array) -> dict[str, Array]:
    """What is measured of how the vehicle runs, at times."""
    rng = np.random.default_rng([timetable.seed, 4])
    at = {
        "speed": timetable.at(timetable.speed, time),
        "yaw_rate": timetable.at(timetable.yaw_rate, time),
        "temperature": timetable.at(timetable.air, time),
        "pressure": EMPTY_PRESSURE * (1 + timetable.at(timetable.load, time)),
    }
    return {name: values + RUNNING[name] * rng.normal(size=len(time)) for name, values in at.items()}


def write_day(vehicle: Vehicle, service: Service, seconds: float, seed: int, path: Path, later: float = 0.0) -> Path:
    """Writes the recording, which begins `later` s after START, and `NAME.truth.json`; returns the truth's path."""
    timetable = draw_timetable(vehicle, service, seconds, seed)
    values = np.concatenate(list(run_day(vehicle, timetable)))
    slow = running_values(timetable, np.arange(0, len(values), SLOW) / SAMPLED)
    {"blf": _write_blf, "mcap": _write_mcap}[path.suffix[1:]](path, vehicle, values, slow, START + round(later * 1e9))
    truth = path.with_suffix(".truth.json")
    truth.write_text(json.dumps(truth_of(vehicle, timetable), indent=1), encoding="utf-8")
    return truth


def truth_of(vehicle: Vehicle, timetable: Timetable) -> dict[str, Any]:
    """What happens in the day, and the elements' values every ten seconds."""
    times = np.arange(0.0, timetable.time[-1], 10.0)
    nominal = np.concatenate([vehicle.stiffness, vehicle.damping])
    values = nominal * np.exp([timetable.log_ratio(vehicle, float(t)) for t in times])
    halves = np.split(values.T.round(2), 2)
    stiffness, damping = (dict(zip(vehicle.elements, half.tolist(), strict=True)) for half in halves)
    return {
        "service": asdict(timetable.service),
        "faults": [asdict(fault) for fault in timetable.service.faults],
        "clocks": timetable.clock_nodes,
        "time": times.tolist(),
        "speed": timetable.at(timetable.speed, times).round(3).tolist(),
        "load": (vehicle.inertia[0] * timetable.at(timetable.load, times)).round(1).tolist(),
        "temperature": timetable.at(timetable.air, times).round(2).tolist(),
        "stiffness": stiffness,
        "damping": damping,
    }  # fmt: skip


def _write_mcap(path: Path, vehicle: Vehicle, values: Array, slow: dict[str, Array], begin: int) -> None:
    """One JSON channel per node and quantity, and one for how the vehicle runs."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="sprung generator")
        writer.add_metadata("recording", {"vehicle": path.stem})
        topics = {**_grouped(vehicle.places, "mcap"), TOPIC: [(name, -1) for name in slow]}
        channels = {}
        for topic, fields in topics.items():
            schema = {"type": "object", "properties": {f: {"type": "number"} for f, _ in fields}}
            title = topic.strip("/").replace("/", ".")
            known = writer.register_schema(title, "jsonschema", json.dumps(schema).encode())
            channels[topic] = writer.register_channel(topic, "json", known)
        for row, sample in enumerate(values.tolist()):
            time = begin + row * PERIOD
            for topic, fields in topics.items():
                if topic == TOPIC and row % SLOW:
                    continue
                remark = (
                    {f: slow[f][row // SLOW] for f, _ in fields}
                    if topic == TOPIC
                    else {f: sample[c] for f, c in fields}
                )
                data = json.dumps({f: float(f"{v:.6g}") for f, v in remark.items()}).encode()
                writer.add_message(channels[topic], time, data, time)
        writer.finish()


BLF_OBJECT = np.dtype(
    [
        ("signature", "S4"), ("header", "<u2"), ("version", "<u2"), ("size", "<u4"), ("type", "<u4"),
        ("flags", "<u4"), ("client", "<u2"), ("object_version", "<u2"), ("time", "<u8"),
        ("channel", "<u2"), ("bits", "u1"), ("length", "u1"), ("id", "<u4"), ("data", "<i2", 4),
    ]
)  # fmt: skip
BLF_TYPE, BLF_NANOSECONDS, BLF_CONTAINER = 1, 2, 10
PER_CONTAINER = 2700  # objects, as usual: about 128 kB
SPREAD = 100_000  # ns between the frames of one sample


def _write_blf(path: Path, vehicle: Vehicle, values: Array, slow: dict[str, Array], begin: int) -> None:
    """Frames of the bundled database, written in columns: a million of them take a second."""
    database = cantools.database.Database()
    database.add_dbc_file(str(DATABASE))
    pieces = []
    for place, (message, signals) in enumerate(_grouped(vehicle.places, "can").items()):
        columns = {name: values[:, column] for name, column in signals}
        pieces.append(_frames(database, message, columns, np.arange(len(values)) * PERIOD + place * SPREAD))
    named = {f"{MESSAGE}{''.join(part.title() for part in name.split('_'))}": v for name, v in slow.items()}
    time = np.arange(len(slow["speed"])) * PERIOD * SLOW + 9 * SPREAD
    pieces.append(_frames(database, MESSAGE, named, time))
    every = np.concatenate(pieces)
    every = every[np.argsort(every["time"], kind="stable")]
    _pack_blf(path, every, begin)


def _frames(database: Any, message: str, columns: dict[str, Array], time: np.ndarray) -> np.ndarray:
    """Objects of one message, signals of 16 bits in a row."""
    definition = database.get_message_by_name(message)
    out = np.zeros(len(time), BLF_OBJECT)
    out["signature"], out["header"], out["version"], out["size"] = b"LOBJ", 32, 1, BLF_OBJECT.itemsize
    out["type"], out["flags"], out["time"] = BLF_TYPE, BLF_NANOSECONDS, time
    out["channel"], out["length"], out["id"] = 1, 8, definition.frame_id
    for name, values in columns.items():
        signal = definition.get_signal_by_name(name)
        out["data"][:, signal.start // 16] = np.clip(np.rint((values - signal.offset) / signal.scale), -32768, 32767)
    return out


def _pack_blf(path: Path, objects: np.ndarray, start: int) -> None:
    """The file: a header, then containers of compressed objects."""
    containers = []
    for first in range(0, len(objects), PER_CONTAINER):
        raw = objects[first : first + PER_CONTAINER].tobytes()
        packed = zlib.compress(raw, 6)
        body = struct.pack("<H6xL4x", 2, len(raw)) + packed
        head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), BLF_CONTAINER)
        containers.append(head + body + bytes(len(body) % 4))
    inflated = objects.nbytes + 32 * len(containers)
    begin, end = (_system_time(start + int(objects["time"][at])) for at in (0, -1))
    header = struct.pack(
        "<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1,
        144 + sum(map(len, containers)), inflated + 144, len(objects), 0, *begin, *end,
    )  # fmt: skip
    with path.open("wb") as stream:
        stream.write(header.ljust(144, b"\0"))
        stream.writelines(containers)


def _system_time(nanoseconds: int) -> tuple[int, ...]:
    """Windows SYSTEMTIME, UTC: year, month, day of the week from Sunday, day, hour, minute, second, ms."""
    at = dt.datetime.fromtimestamp(nanoseconds // 1_000_000 / 1e3, dt.UTC)
    return (at.year, at.month, at.isoweekday() % 7, at.day, at.hour, at.minute, at.second, at.microsecond // 1000)
