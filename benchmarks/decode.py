"""`decode`: how fast recordings become samples, against the libraries that a user would call in a loop.

- CAN: frames a second from frames in memory to physical values.  The peer decodes the same frames with
  `cantools` one by one, looking the message up by its identifier, as its documentation shows.
- MCAP: messages a second from a file to numbers.  The peer iterates over the file with the `mcap` package's
  reader and calls `json.loads` on every message.

Both sides run alternately in one process and one thread; processor time of the best of three rounds counts, so that
other load hurts little and both alike.
Without paths the input is made here: 7 messages of 4 signals each at 100 Hz, as a bogie monitor sends them.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from mcap.reader import make_reader
from mcap.writer import Writer

from sprung.model.signals import Channel
from sprung.replay import open_recording
from sprung.replay.account import Account
from sprung.replay.candecode import CanDecoder
from sprung.replay.frames import EXTENDED, FrameBlock
from sprung.replay.recording import CAN_READERS

MESSAGES, SIGNALS = 7, 4
ROUNDS = 3
PEER_FRAMES = 40_000  # of the recording that the slow side decodes in one round
START = 1_790_000_000_000_000_000


def run(
    can: str | None = None, dbc: str | None = None, mcap: str | None = None, seconds: float = 60.0
) -> Iterator[dict[str, Any]]:
    """One dict per figure: name, value, unit, peer, ratio, target.  `can` with `dbc`, and `mcap`, are files to read
    instead of the made ones, which are `seconds` long."""
    if (can is None) != (dbc is None):
        raise ValueError("bench decode: --can and --dbc belong together")
    with tempfile.TemporaryDirectory() as folder:
        database = _load(dbc) if dbc else _database()
        frames = _read_frames(Path(can)) if can else _frames(database, seconds)
        yield _can_figure(database, frames)
        path = Path(mcap) if mcap else _write_mcap(Path(folder) / "made.mcap", seconds)
        yield _mcap_figure(path)


def _load(dbc: str) -> Database:
    database = cantools.database.load_file(dbc, strict=False)
    if not isinstance(database, Database):
        raise ValueError(f"{dbc}: not a CAN database")
    return database


def _can_figure(database: Database, blocks: Sequence[FrameBlock]) -> dict[str, Any]:
    known = {m.frame_id | (EXTENDED if m.is_extended_frame else 0): m for m in database.messages}
    present = {int(i) for block in blocks for i in np.unique(block.id)} & set(known)
    channels = [
        Channel(f"{i}.{s.name}", "1", 1.0, can=f"{known[i].name}.{s.name}") for i in present for s in known[i].signals
    ]
    decoder = CanDecoder(channels, database)
    total = sum(len(block.time) for block in blocks)
    loop = [
        (int(frame_id), data[: int(length)].tobytes())
        for block in blocks
        for frame_id, length, data in zip(block.id, block.length, block.data, strict=True)
    ][:PEER_FRAMES]

    def product() -> None:
        for block in blocks:
            decoder.decode(block, Account())

    def peer() -> None:
        for frame_id, data in loop:
            if frame_id in present:
                database.decode_message(frame_id & 0x1FFFFFFF, data, decode_choices=False, allow_truncated=True)

    ours, theirs = _best(product, peer)
    return _figure("CAN decoding", total / ours, "frames/s", len(loop) / theirs, 20.0)


def _mcap_figure(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        reader = make_reader(file)
        topics = {}
        for _, channel, message in reader.iter_messages():
            if channel.topic not in topics and channel.message_encoding == "json":
                topics[channel.topic] = list(json.loads(message.data))
            if len(topics) >= MESSAGES:
                break
    channels = [Channel(f"{t}.{f}", "1", 1.0, mcap=f"{t}.{f}") for t, fields in topics.items() for f in fields]
    counts = [0, 0]

    def product() -> None:
        recording = open_recording(path, channels)
        for _ in recording.blocks():
            pass
        counts[0] = sum(recording.tally.as_dict().values())

    def peer() -> None:
        with path.open("rb") as file:
            counts[1] = 0
            for _, _, message in make_reader(file).iter_messages():
                json.loads(message.data)
                counts[1] += 1

    ours, theirs = _best(product, peer)
    return _figure("MCAP decoding", counts[0] / ours, "messages/s", counts[1] / theirs, 0.7)


def _best(product: Callable[[], None], peer: Callable[[], None]) -> tuple[float, float]:
    """Processor seconds of the fastest of some alternating rounds."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for work, taken in zip((product, peer), times, strict=True):
            begun = time.process_time()
            work()
            taken.append(time.process_time() - begun)
    return min(times[0]), min(times[1])


def _figure(name: str, value: float, unit: str, peer: float, target: float) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": value / peer, "target": target}


def _read_frames(path: Path) -> list[FrameBlock]:
    return list(CAN_READERS[path.suffix.lower()](path, Account()))


def _database() -> Database:
    conversion = BaseConversion.factory(scale=5e-4, offset=0)
    messages = []
    for number in range(MESSAGES):
        signals = [
            Signal(f"S{number}{i}", 16 * i, 16, is_signed=True, conversion=conversion, minimum=-16.384, maximum=16.3835)
            for i in range(SIGNALS)
        ]
        messages.append(Message(0x310 + number, f"M{number}", 8, signals))
    return Database(messages)


def _frames(database: Database, seconds: float) -> list[FrameBlock]:
    """Random payloads, so that nothing about the values can help."""
    count = round(seconds * 100) * MESSAGES
    data = np.random.default_rng(0).integers(0, 256, (count, 8), dtype=np.uint8)
    ids = np.tile(np.array([m.frame_id for m in database.messages], dtype=np.uint32), count // MESSAGES)
    times = START + np.arange(count) * (10_000_000 // MESSAGES)
    length = np.full(count, 8, dtype=np.uint8)
    edges = range(0, count, 8192)
    return [FrameBlock(times[i : i + 8192], ids[i : i + 8192], length[i : i + 8192], data[i : i + 8192]) for i in edges]


def _write_mcap(path: Path, seconds: float) -> Path:
    values = np.random.default_rng(0).normal(size=(round(seconds * 100), MESSAGES, SIGNALS))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("four", "jsonschema", b'{"type": "object"}')
        topics = [writer.register_channel(f"/node{i}/acceleration", "json", schema) for i in range(MESSAGES)]
        names = ("front_left", "front_right", "rear_left", "rear_right")
        for row, step in enumerate(values):
            for topic, four in zip(topics, step.tolist(), strict=True):
                document = json.dumps(dict(zip(names, (round(x, 7) for x in four), strict=True))).encode()
                moment = START + row * 10_000_000
                writer.add_message(topic, moment, document, moment, row)
        writer.finish()
    return path


if __name__ == "__main__":
    for figure in run():
        print(json.dumps(figure))
