"""What the readers of textual CAN logs share: batches of parsed lines to blocks of frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sprung.replay.account import Account
from sprung.replay.frames import FrameBlock

BATCH_BYTES = 1 << 19


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
    """The lines of a file in batches of about half a megabyte."""
    with path.open("rb") as file:
        while lines := file.readlines(BATCH_BYTES):
            yield lines


def decimal_ns(text: bytes) -> int:
    """Seconds in decimal notation, as exact nanoseconds; raises ValueError when it is no number."""
    whole, _, fraction = text.partition(b".")
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, b"0") or b"0")


def _is_hex(payload: bytes) -> bool:
    try:
        bytes.fromhex(payload.decode("ascii"))
    except ValueError:
        return False
    return len(payload) in (16, 128)
