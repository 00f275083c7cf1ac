"""What the readers of textual CAN logs share: bounded lines, exact numbers, and batches of them as blocks of frames."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from sprung.replay.account import Account
from sprung.replay.frames import EXTENDED, FrameBlock
from sprung.replay.plausibility import EARLIEST, LATEST

BATCH_BYTES = 1 << 19
LONGEST_LINE = 1 << 12  # bytes; an FD frame in decimal digits takes about 400
LONGEST_SECONDS = 10  # digits: until the year 2286
LARGEST_ID = (1 << 29) - 1
DIGITS = frozenset(b"0123456789")
HEX_DIGITS = frozenset(b"0123456789abcdefABCDEF")
BY_BASE = {10: DIGITS, 16: HEX_DIGITS}


class LineFrames:
    """Collects the frames of one batch of lines; payloads are hexadecimal text, whole bytes."""

    def __init__(self) -> None:
        self.time: list[int] = []
        self.id: list[int] = []
        self.payload: list[bytes] = []

    def add(self, time: int, frame_id: int, payload: bytes) -> None:
        self.time.append(time)
        self.id.append(frame_id)
        self.payload.append(payload)

    def block(self, account: Account) -> FrameBlock:
        """The batch as columns; a line whose payload is not hexadecimal is counted as corrupt."""
        width = 8 if max(map(len, self.payload), default=0) <= 16 else 64
        digits = 2 * width
        padded = [payload.ljust(digits, b"0") for payload in self.payload]
        try:
            data = bytes.fromhex(b"".join(padded).decode("ascii"))
            good = np.ones(len(padded), dtype=bool)
        except ValueError:
            good = np.array([_is_hex(payload) for payload in padded])
            account.corrupt(int((~good).sum()), "payload is not hexadecimal")
            data = bytes.fromhex("".join(p.decode("ascii") for p, ok in zip(padded, good, strict=True) if ok))
        length = np.array([len(payload) // 2 for payload in self.payload], dtype=np.uint8)
        return FrameBlock(
            np.array(self.time, dtype=np.int64)[good],
            np.array(self.id, dtype=np.uint32)[good],
            length[good],
            np.frombuffer(data, dtype=np.uint8).reshape(-1, width),
        )


def line_batches(path: Path) -> Iterator[list[bytes]]:
    """The lines of a file in batches of about half a megabyte; of a line that is too long only its beginning, which
    no reader takes for a frame."""
    with path.open("rb") as file:
        rest = b""
        while piece := file.read(BATCH_BYTES):
            lines = (rest + piece).splitlines(keepends=True)
            rest = b"" if lines[-1].endswith(b"\n") else lines.pop()
            if len(rest) > LONGEST_LINE:
                rest = rest[:LONGEST_LINE]
            if lines:
                yield [line if len(line) <= LONGEST_LINE else line[:LONGEST_LINE] for line in lines]
        if rest:
            yield [rest]


def note_cut_frames(lines: list[bytes], account: Account) -> None:
    """Say that a file ends inside a line: every program that logs writes its lines with their ends."""
    if not lines[-1].endswith((b"\n", b"\r")):
        account.problem("the file ends inside a line: it was cut there, or its last line was")


def decimal_ns(text: bytes) -> int:
    """Seconds in decimal notation, as exact nanoseconds; raises ValueError when they are no number or no time."""
    whole, _, fraction = text.partition(b".")
    if not (whole + fraction).isdigit() or not 0 < len(whole) <= LONGEST_SECONDS:
        if text[:1] == b"-" and text[1:2] != b"-":
            return in_time(-decimal_ns(text[1:]))
        raise ValueError("no time")
    return in_time(int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0")))


def in_time(time: int) -> int:
    """The same; raises ValueError when no clock shows it."""
    if not EARLIEST <= time <= LATEST:
        raise ValueError("time stamp out of range")
    return time


def integer(text: bytes, base: int) -> int:
    """A number of digits only (Python would take underscores, signs and spaces, too); raises ValueError."""
    if len(text) > 20 or not BY_BASE[base].issuperset(text):
        raise ValueError("no number")
    return int(text, base)


@lru_cache(maxsize=4096)  # a bus has a few hundred, every one in thousands of lines
def frame_id(text: bytes, base: int, *, extended: bool) -> int:
    """An identifier as `FrameBlock.id` has it; raises ValueError when it has more bits than identifiers have."""
    identifier = integer(text, base)
    if identifier > LARGEST_ID:
        raise ValueError("identifier of more than 29 bits")
    return identifier | EXTENDED if extended else identifier


def _is_hex(payload: bytes) -> bool:
    try:
        bytes.fromhex(payload.decode("ascii"))
    except ValueError:
        return False
    return len(payload) in (16, 128)
