"""Rides of the bundled vehicle by the repository's own generator, whole, with losses, and cut off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import can
import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.generator.files import WRITERS
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER

VEHICLE = "demo-0001"
MESSAGES = 7  # of one sample: four channels in each
LOST, FOREIGN = 0.02, 0.05  # of the messages


@dataclass(frozen=True)
class RecordedRide:
    """A recording and the truth about it."""

    path: Path
    truth: dict[str, float]  # of each parameter
    values: FloatArray  # (T, C)
    channels: list[str]  # their names
    lost: int = 0  # messages that were written by none
    foreign: int = 0  # frames of other identifiers


def make_ride(path: Path, seconds: float, seed: int) -> RecordedRide:
    """A healthy vehicle, in the format of the path's suffix."""
    vehicle = read_vehicle(MANCHESTER)
    (case,) = draw_cases(vehicle, 1, seed, ["clean"])
    (made,) = make_recordings(vehicle, [case], seconds)
    WRITERS[path.suffix[1:]](path, vehicle, made.values, VEHICLE)
    of = {"stiffness": case.stiffness, "damping": case.damping}
    truth = {f"{element}.{quantity}": v for quantity in of for element, v in of[quantity].items()}
    return RecordedRide(path, truth, made.values, vehicle.channels)


def with_losses(ride: RecordedRide, path: Path, seed: int = 1) -> RecordedRide:
    """The same with a share of its messages gone, on a CAN bus with frames of others among them."""
    random = np.random.default_rng(seed)
    copy = _mcap_with_losses if path.suffix == ".mcap" else _can_with_losses
    lost, foreign = copy(ride.path, path, random)
    return replace(ride, path=path, lost=lost, foreign=foreign)


def cut_off(ride: RecordedRide, path: Path, share: float) -> RecordedRide:
    """The first bytes of the file, as after a power failure."""
    whole = ride.path.read_bytes()
    path.write_bytes(whole[: round(share * len(whole))])
    return replace(ride, path=path)


def _mcap_with_losses(source: Path, path: Path, random: np.random.Generator) -> tuple[int, int]:
    lost = 0
    with source.open("rb") as old, path.open("wb") as new:
        writer = Writer(new)
        writer.start()
        writer.add_metadata("recording", {"vehicle": VEHICLE})
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            if random.random() < LOST:
                lost += 1
            else:
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return lost, 0


def _can_with_losses(source: Path, path: Path, random: np.random.Generator) -> tuple[int, int]:
    lost = foreign = 0
    with can.LogReader(source) as frames, can.Logger(str(path)) as logger:
        for frame in frames:
            if random.random() < LOST:
                lost += 1
            else:
                logger(frame)
            if random.random() < FOREIGN:
                foreign += 1
                other = can.Message(
                    timestamp=frame.timestamp, arbitration_id=0x7A0, data=random.bytes(8), is_extended_id=False
                )
                other.channel = frame.channel
                logger(other)
    return lost, foreign
