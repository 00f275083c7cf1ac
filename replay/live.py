"""A live CAN bus as blocks of samples, and a sender that plays a CAN recording onto a bus."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from cantools.database import Database

from sprung.model.signals import Channel, SampleBlock, Tally
from sprung.model.text import first_line
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.bus import BusAddress, lost_by_kernel, not_only_listened_to, opening_options, widen
from sprung.replay.candecode import CanDecoder
from sprung.replay.convert import converter
from sprung.replay.frames import EXTENDED, FrameBlock
from sprung.replay.plausibility import OUT_OF_TIME, PlausibilityCheck, nanoseconds
from sprung.replay.recording import CAN_READERS

log = logging.getLogger("sprung.live")
FIRST_RETRY, LAST_RETRY = 0.5, 10.0  # s, doubled from try to try
MOST_FRAMES = 4096  # frames of one block, so that a flooded bus stays bounded in memory
BUS_ERRORS = (can.CanError, OSError, ValueError)
BEHIND_SECONDS = 5.0  # frames that wait longer are not worth reading: they are given up until ...
CAUGHT_UP_SECONDS = 0.5  # ... the reader is this close again
CLOCK_STEP_SECONDS = 120.0  # a longer delay than this is a clock that was set, not a queue
ASK_SECONDS = 5.0  # between two looks at the kernel's counters
ERROR_BUS_OFF, ERROR_RESTARTED = 0x40, 0x100  # classes of error frames, as linux/can/error.h names them
NO_FRAME = "datagram is no frame"
BUS_OFF = "the controller is bus-off; give `ip link set` a `restart-ms` for it to come back by itself"
DATAGRAMS = ("udp_multicast",)  # interfaces on which whoever is on the network may send anything, a datagram at a time
OFFSET_DRIFT = 1e-3  # by which the clock of an interface may drift against the host's


class LiveBus:
    """Any python-can interface (`socketcan`, `virtual`, `udp_multicast`, ...), opened again when it is lost.

    Time stamps are those of the interface.  `stop` ends `blocks()` within one latency.  The bus is only listened to,
    and filtered by the kernel, where the interface can.  A reader that falls behind gives up what waits, counted, and
    goes on with what is new.
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
        self.address = BusAddress(interface, channel, options)
        self.name = self.address.name
        self.stop = stop or threading.Event()
        self.account = Account()
        self.connected = False
        self.reconnects = 0
        self.trouble = ""  # why the bus is not connected
        self.lost = 0  # frames that the kernel dropped
        self.lag = 0.0  # s that the last frame had waited, against the quickest one
        self.beat = time.monotonic()  # when the reader last came by; one that hangs does not
        self._offset = math.inf  # s, host's clock less the interface's
        self._lost_before = 0
        self._behind = False
        self._asked = 0.0
        self._told = False  # who has to know that it is not only listened to
        self._decoder = CanDecoder(channels, dbc)
        self._decoder.compare_units(self.account)
        for line in self.account.problems:
            log.warning("%s: %s", self.name, line)
        self._plausibility = PlausibilityCheck(channels, self.account, converter(channels))
        self._ids = frozenset(self._decoder.ids.tolist())
        self._latency = latency
        wanted = opening_options(self.address, sorted(self._ids))
        self._open = lambda: open_bus(interface=interface, channel=channel, **wanted)

    @property
    def tally(self) -> Tally:
        """Frames so far, by outcome."""
        return self.account.tally

    @property
    def problems(self) -> list[str]:
        """One line for every time the bus was lost."""
        return self.account.problems

    def blocks(self) -> Iterator[SampleBlock]:
        """Samples as they come, at most `latency` s after their frames; ends when `stop` is set."""
        retry = FIRST_RETRY
        while not self.stop.is_set():
            self.beat = time.monotonic()  # a bus that is absent is looked for: the reader does not hang
            try:
                with self._open() as bus:  # type: ignore[no-untyped-call]  # of python-can
                    widen(bus)
                    self._opened(bus)
                    for messages in self._receive(bus):
                        retry = FIRST_RETRY
                        self._note_errors(messages)
                        self._ask(bus)
                        wanted = self._current(self._wanted(messages))
                        if not wanted:
                            continue
                        block = self._plausibility.check(
                            self._decoder.decode(frame_block(wanted, self.account), self.account)
                        )
                        if len(block.time):
                            yield block
            except BUS_ERRORS as error:
                self._note_loss(error, retry)
                self.stop.wait(retry)
                retry = min(2.0 * retry, LAST_RETRY)
            finally:
                self.connected = False

    def _receive(self, bus: can.BusABC) -> Iterator[list[can.Message]]:
        """Frames collected during one latency.  Errors: those of the bus."""
        while not self.stop.is_set():
            self.beat = time.monotonic()
            message = self._next(bus, self._latency)
            if message is None:
                continue
            messages = [message]
            end = time.monotonic() + self._latency
            try:
                while (left := end - time.monotonic()) > 0 and len(messages) < MOST_FRAMES:
                    message = self._next(bus, left)
                    if message is not None:
                        messages.append(message)
            except BUS_ERRORS:
                yield messages  # frames received before the bus was lost
                raise
            yield messages

    def _next(self, bus: can.BusABC, timeout: float) -> can.Message | None:
        """The next frame; None where none came in time, or what came is none.  Errors: those of the bus."""
        if self.address.interface not in DATAGRAMS:
            return bus.recv(timeout=timeout)
        try:
            message = bus.recv(timeout=timeout)
        except can.CanError as error:
            if isinstance(error.__cause__, OSError | None):
                raise
            self.account.corrupt(1, NO_FRAME)  # it costs itself, not the bus
            return None
        if message is not None and type(message.arbitration_id) is not int:  # nor does python-can look at types
            self.account.corrupt(1, NO_FRAME)
            return None
        return message

    def _opened(self, bus: can.BusABC) -> None:
        self._note_connected()
        self._offset, self._behind, self.lag = math.inf, False, 0.0
        self._lost_before = lost_by_kernel(bus, self.address)
        if not self._told:
            self._told = True
            if advice := not_only_listened_to(self.address):
                log.warning("%s: %s", self.name, advice)

    def _ask(self, bus: can.BusABC) -> None:
        """Add the frames dropped by the kernel since the last call."""
        now = time.monotonic()
        if now - self._asked < ASK_SECONDS:
            return
        self._asked = now
        lost = lost_by_kernel(bus, self.address)
        if lost > self._lost_before:
            self.lost += lost - self._lost_before
            self.account.drop(lost - self._lost_before, "dropped by the kernel")
            self.account.incomplete = True
        self._lost_before = lost

    def _note_errors(self, messages: list[can.Message]) -> None:
        """Report once that a controller is off the bus: it receives nothing until it is restarted."""
        if self.address.interface != "socketcan":  # other interfaces report it differently
            return
        for message in messages:
            off = message.is_error_frame and bool(message.arbitration_id & ERROR_BUS_OFF)
            if off and self.connected:
                self._note_trouble(BUS_OFF)
            on = not message.is_error_frame or bool(message.arbitration_id & ERROR_RESTARTED)
            if on and not off and not self.connected:
                self._note_connected()

    def _wanted(self, messages: list[can.Message]) -> list[can.Message]:
        """Without frames of other ids: on a busy bus most are, and looking closer costs more than they are worth."""
        ids = self._ids
        wanted = [m for m in messages if (m.arbitration_id | (EXTENDED if m.is_extended_id else 0)) in ids]
        self.account.foreign(len(messages) - len(wanted))
        return wanted

    def _current(self, messages: list[can.Message]) -> list[can.Message]:
        """The messages, or none of them while the reader is too far behind."""
        if not messages:
            return messages
        waited = time.time() - messages[-1].timestamp
        self._offset = min(self._offset + OFFSET_DRIFT * self._latency, waited)
        if waited - self._offset > CLOCK_STEP_SECONDS:  # no queue is so long: one of the clocks was set
            self._offset = waited
        self.lag = waited - self._offset
        if self.lag > (CAUGHT_UP_SECONDS if self._behind else BEHIND_SECONDS):
            self._behind = True
            self.account.drop(len(messages), "given up by a reader that was behind")
            self.account.incomplete = True
            return []
        self._behind = False
        return messages

    def _note_loss(self, error: Exception, retry: float) -> None:
        self.reconnects += 1
        self._note_trouble(first_line(error), f"; trying again in {retry:.1f} s")

    def _note_trouble(self, trouble: str, next_step: str = "") -> None:
        """`connected` last, here and below: whoever reads it in another thread finds the reason already there."""
        self.account.problem(f"bus {self.name} lost: {trouble}{next_step}")
        self.trouble = trouble
        self.connected = False

    def _note_connected(self) -> None:
        self.trouble = ""
        self.connected = True


def frame_block(messages: Sequence[can.Message], account: Account) -> FrameBlock:
    """python-can messages as columns; error and remote frames are counted as foreign."""
    frames = [message for message in messages if not (message.is_error_frame or message.is_remote_frame)]
    account.foreign(len(messages) - len(frames), "error or remote frame")
    time, timely = nanoseconds(np.array([message.timestamp for message in frames], dtype=np.float64))
    if not timely.all():
        account.corrupt(int((~timely).sum()), OUT_OF_TIME)
        frames, time = [message for message, good in zip(frames, timely, strict=True) if good], time[timely]
    width = 64 if any(len(message.data) > 8 for message in frames) else 8
    data = b"".join(bytes(message.data).ljust(width, b"\0") for message in frames)
    return FrameBlock(
        time,
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
