"""A live CAN bus as blocks of samples, and a sender that plays a CAN recording onto a bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from cantools.database import Database

from sprung.model.signals import Channel, SampleBlock, Tally
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.candecode import CanDecoder
from sprung.replay.convert import converter
from sprung.replay.frames import EXTENDED, FrameBlock
from sprung.replay.recording import CAN_READERS

FIRST_RETRY, LAST_RETRY = 0.5, 10.0  # s, doubled from try to try
MOST_FRAMES = 4096  # frames of one block, so that a flooded bus stays bounded in memory
KEPT_PROBLEMS = 100  # lines; a bus may flap for weeks
BUS_ERRORS = (can.CanError, OSError, ValueError)


class LiveBus:
    """Any python-can interface (`socketcan`, `virtual`, `udp_multicast`, ...), opened again when it is lost.

    Time stamps are those of the interface.  `stop` ends `blocks()` within one latency.
    """

    def __init__(
        self,
        interface: str,
        channel: str,
        channels: Sequence[Channel],
        dbc: str | Path | Database,
        *,
        latency: float = 0.05,
        stop: threading.Event | None = None,
        open_bus: Callable[..., can.BusABC] = can.Bus,
        **options: Any,
    ) -> None:
        """`options` go to python-can (`bitrate`, `port`, ...); raises UnreadableRecording for a wrong database or
        an interface that python-can does not know."""
        if interface not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise UnreadableRecording(f"CAN interface {interface!r} is not known; python-can has {known}")
        self.name = f"{interface}:{channel}"
        self.stop = stop or threading.Event()
        self.account = Account()
        self.connected = False
        self.reconnects = 0
        self._decoder = CanDecoder(channels, dbc)
        self._convert = converter(channels)
        self._latency = latency
        self._open = lambda: open_bus(interface=interface, channel=channel, **options)

    @property
    def tally(self) -> Tally:
        """Frames so far, by what became of them."""
        return self.account.tally

    @property
    def problems(self) -> list[str]:
        """One line for every time the bus was lost."""
        return self.account.problems

    def blocks(self) -> Iterator[SampleBlock]:
        """Samples as they come, at most `latency` s after their frames; ends when `stop` is set."""
        retry = FIRST_RETRY
        while not self.stop.is_set():
            try:
                with self._open() as bus:  # type: ignore[no-untyped-call]
                    self.connected = True
                    for messages in self._receive(bus):
                        retry = FIRST_RETRY
                        block = self._convert(self._decoder.decode(frame_block(messages, self.account), self.account))
                        if len(block.time):
                            yield block
            except BUS_ERRORS as error:
                self._lost(error, retry)
                self.stop.wait(retry)
                retry = min(2.0 * retry, LAST_RETRY)
            finally:
                self.connected = False

    def _receive(self, bus: can.BusABC) -> Iterator[list[can.Message]]:
        """Frames collected for one latency; raises what the bus raises."""
        while not self.stop.is_set():
            message = bus.recv(timeout=self._latency)
            if message is None:
                continue
            messages = [message]
            end = time.monotonic() + self._latency
            try:
                while (left := end - time.monotonic()) > 0 and len(messages) < MOST_FRAMES:
                    message = bus.recv(timeout=left)
                    if message is not None:
                        messages.append(message)
            except BUS_ERRORS:
                yield messages  # what came before the bus was lost still counts
                raise
            yield messages

    def _lost(self, error: Exception, retry: float) -> None:
        self.reconnects += 1
        if len(self.account.problems) < KEPT_PROBLEMS:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            self.account.problem(f"bus {self.name} lost: {line}; trying again in {retry:.1f} s")


def frame_block(messages: Sequence[can.Message], account: Account) -> FrameBlock:
    """python-can messages as columns; error and remote frames are counted as foreign."""
    frames = [message for message in messages if not (message.is_error_frame or message.is_remote_frame)]
    account.foreign(len(messages) - len(frames), "error or remote frame")
    width = 64 if any(len(message.data) > 8 for message in frames) else 8
    data = b"".join(bytes(message.data).ljust(width, b"\0") for message in frames)
    return FrameBlock(
        np.array([round(message.timestamp * 1e9) for message in frames], dtype=np.int64),
        np.array(
            [message.arbitration_id | (EXTENDED if message.is_extended_id else 0) for message in frames],
            dtype=np.uint32,
        ),
        np.array([len(message.data) for message in frames], dtype=np.uint8),
        np.frombuffer(data, dtype=np.uint8).reshape(-1, width),
    )


def send(
    path: str | Path,
    interface: str,
    channel: str,
    speed: float = 1.0,
    *,
    stop: threading.Event | None = None,
    clock: Callable[[], float] = time.monotonic,
    **options: Any,
) -> int:
    """Play a CAN recording onto a bus at `speed` times real time; returns the number of frames sent.

    A receiver stamps frames when they arrive, so at another speed than 1 it sees another sampling rate.
    """
    path = Path(path)
    reader = CAN_READERS.get(path.suffix.lower())
    if reader is None:
        raise UnreadableRecording(f"{path}: not a CAN recording; known are {' '.join(CAN_READERS)}")
    if not speed > 0:
        raise UnreadableRecording(f"speed must be positive, not {speed}")
    stop = stop or threading.Event()
    sent = 0
    with can.Bus(interface=interface, channel=channel, **options) as bus:
        begun, first = clock(), None
        for block in reader(path, Account()):
            first = int(block.time[0]) if first is None else first
            for index, message in enumerate(_messages(block)):
                wait = begun + (int(block.time[index]) - first) / 1e9 / speed - clock()
                if wait > 0 and stop.wait(wait):
                    return sent
                bus.send(message)
                sent += 1
    return sent


def _messages(block: FrameBlock) -> Iterator[can.Message]:
    for time_ns, frame_id, length, data in zip(block.time, block.id, block.length, block.data, strict=True):
        yield can.Message(
            timestamp=int(time_ns) / 1e9,
            arbitration_id=int(frame_id) & 0x1FFFFFFF,
            is_extended_id=bool(int(frame_id) & EXTENDED),
            is_fd=int(length) > 8,
            data=data[: int(length)].tobytes(),
        )
