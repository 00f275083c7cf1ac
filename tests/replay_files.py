"""One small recording in every format, written by the libraries that others use, and a way to read it back."""

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import CompressionType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer

from sprung.model.signals import Channel, FloatArray, IntArray
from sprung.replay import open_recording
from sprung.replay.recording import Recording

START = 1_790_000_000_000_000_000
STEP = 10_000_000
ROWS = 300
CHANNELS = [
    Channel("left", "m/s^2", 0.01, mcap="/body/acceleration.left", can="Body.Left", csv="left"),
    Channel("right", "m/s^2", 0.01, mcap="/body/acceleration.axes[1].right", can="Body.Right", csv="right"),
]
NUMBERS = np.arange(ROWS)
LEFT: FloatArray = np.round(np.sin(NUMBERS / 7.0), 3).astype(np.float64)
RIGHT: FloatArray = np.round(2.0 * np.cos(NUMBERS / 5.0), 3)
VALUES = np.stack([LEFT, RIGHT], axis=1)
TIMES = START + NUMBERS * STEP
Samples = dict[int, tuple[IntArray, FloatArray]]  # of each channel: times, ns, and values


def document(row: int) -> dict[str, Any]:
    return {"left": LEFT[row], "axes": [{"right": 0.0}, {"right": RIGHT[row]}]}


def write_json(
    path: Path,
    *,
    chunk: int = 4096,
    compression: CompressionType = CompressionType.ZSTD,
    close: bool = True,
    chunked: bool = True,
    crcs: bool = True,
) -> None:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk, compression=compression, use_chunking=chunked, enable_crcs=crcs)
        writer.start()
        writer.add_metadata("recording", {"vehicle": "tram-7"})
        schema = writer.register_schema("Body", "jsonschema", b'{"type": "object"}')
        body = writer.register_channel("/body/acceleration", "json", schema)
        other = writer.register_channel("/door/state", "json", schema)
        for row in range(ROWS):
            time = int(TIMES[row])
            writer.add_message(body, time + 3_000_000, json.dumps(document(row)).encode(), time, row)
            if row % 10 == 0:
                writer.add_message(other, time, b'{"open": false}', time, row)
        if close:
            writer.finish()


def protobuf_class() -> Any:
    """message Body { Timestamp timestamp; double left; repeated Axis axes; }"""
    file = descriptor_pb2.FileDescriptorProto(name="body.proto", package="t", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    axis = file.message_type.add(name="Axis")
    axis.field.add(name="right", number=1, type=1, label=1)
    body = file.message_type.add(name="Body")
    body.field.add(name="timestamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp")
    body.field.add(name="left", number=2, type=1, label=1)
    body.field.add(name="axes", number=3, type=11, label=3, type_name=".t.Axis")
    pool = descriptor_pool.DescriptorPool()
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    pool.Add(timestamp)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Body"))


def write_protobuf(path: Path) -> None:
    kind = protobuf_class()
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for row in range(ROWS):
            message = kind(left=LEFT[row], axes=[{"right": 0.0}, {"right": RIGHT[row]}])
            message.timestamp.FromNanoseconds(int(TIMES[row]))
            late = int(TIMES[row]) + 7_000_000  # the stamp inside counts, not this
            writer.write_message("/body/acceleration", message, late, late)


ROS_BODY = """std_msgs/Header header
float64 left
Axis[] axes
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: test_msgs/Axis
float32 right
"""


def write_ros2(path: Path, stamped: bool = True, bursts: int = 1) -> None:
    """bursts: messages that are logged together, after the last of them."""
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("test_msgs/Body", ROS_BODY)
        for row in range(ROWS):
            stamp = int(TIMES[row]) if stamped else 0
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "b"}
            last = min(row - row % bursts + bursts, ROWS) - 1
            late = int(TIMES[last]) + (7_000_000 if stamped else 0)
            writer.write_message("/body/acceleration", schema, {"header": header, **document(row)}, late, late)
        writer.finish()


def database() -> Database:
    conversion = BaseConversion.factory(scale=0.001, offset=0)
    wide: dict[str, Any] = {"is_signed": True, "conversion": conversion, "minimum": -30, "maximum": 30}
    signals = [Signal("Left", 0, 16, **wide), Signal("Right", 23, 16, byte_order="big_endian", **wide)]
    return Database([Message(0x310, "Body", 8, signals)])


def frame(row: int, frame_id: int = 0x310, **options: Any) -> can.Message:
    data = database_message.encode({"Left": LEFT[row], "Right": RIGHT[row]})
    return can.Message(
        timestamp=int(TIMES[row]) / 1e9, arbitration_id=frame_id, is_extended_id=False, data=data, **options
    )


database_message = database().messages[0]


def write_can(path: Path) -> None:
    """Every tenth cycle brings a frame of another id, an extended one, a remote frame and an error frame."""
    with can.Logger(str(path)) as logger:
        for row in range(ROWS):
            logger.on_message_received(frame(row, channel=0))
            if row % 10 == 0:
                stamp = int(TIMES[row]) / 1e9
                extra: dict[str, Any] = {"timestamp": stamp, "channel": 0}
                logger.on_message_received(can.Message(arbitration_id=0x311, is_extended_id=False, data=b"1", **extra))
                logger.on_message_received(can.Message(arbitration_id=0x310, data=b"12345678", **extra))
                remote = can.Message(arbitration_id=0x310, is_extended_id=False, is_remote_frame=True, dlc=8, **extra)
                logger.on_message_received(remote)


def write_csv(path: Path) -> None:
    rows = [f"{NUMBERS[i] / 100:.2f},{RIGHT[i]},{LEFT[i]},x" for i in range(ROWS)]
    path.write_text("\n".join(["time,right,left,note", *rows]) + "\n")


def read(
    path: Path, dbc: Path | Database | None = None, channels: Sequence[Channel] = CHANNELS, **options: Any
) -> tuple[Recording, Samples]:
    """(recording, {channel: (times, values)})."""
    recording = open_recording(path, channels, dbc=dbc, **options)
    parts = defaultdict(list)
    for block in recording.blocks():
        for index in range(len(channels)):
            own = block.channel == index
            parts[index].append((block.time[own], block.value[own]))
    return recording, {
        index: (np.concatenate([t for t, _ in found]), np.concatenate([v for _, v in found]))
        for index, found in parts.items()
    }


def uff58(
    node: int,
    direction: int,
    values: FloatArray,
    *,
    kind: int = 4,
    even: bool = True,
    binary: str | None = None,
    date: str = "NONE",
    unit: str = "N",
    times: FloatArray = NUMBERS / 100,
) -> bytes:
    """One dataset 58 as its definition has it."""
    head = [
        f"    58{'' if binary is None else 'b'}",
        "Signal of a test".ljust(80),
        "NONE",
        date,
        "NONE",
        "NONE",
        f"{1:5d}{0:10d}{0:5d}{0:10d} {'NONE':>10s}{node:10d}{direction:4d} {'NONE':>10s}{0:10d}{0:4d}",
        f"{kind:10d}{len(values):10d}{int(even):10d}{times[0]:13.5E}{0.01:13.5E}{0:13.5E}",
        f"{17:10d}{0:5d}{0:5d}{0:5d} {'Time':>20s} {'s':>20s}",
        f"{13:10d}{0:5d}{0:5d}{0:5d} {'Force':>20s} {unit:>20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':>20s} {'NONE':>20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':>20s} {'NONE':>20s}",
    ]
    if binary is not None:
        data = np.asarray(values, dtype=f"{binary}{'f8' if kind == 4 else 'f4'}").tobytes()
        head[0] += f"{1 if binary == '<' else 2:6d}{2:6d}{11:12d}{len(data):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
        body = data + b"\n"
    else:
        if not even:
            cells = [
                f"{t:13.5E}" + (f"{v:20.12E}" if kind == 4 else f"{v:13.5E}")
                for t, v in zip(times, values, strict=True)
            ]
            per_line = 2 if kind == 4 else 3
        else:
            cells = [f"{v:20.12E}" if kind == 4 else f"{v:13.5E}" for v in values]
            per_line = 4 if kind == 4 else 6
        lines = ["".join(cells[i : i + per_line]) for i in range(0, len(cells), per_line)]
        body = ("\n".join(lines) + "\n").encode()
    return b"    -1\n" + "\n".join(head).encode() + b"\n" + body + b"    -1\n"
