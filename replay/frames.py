"""CAN frames in columns, and the bits of a signal taken from many frames at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import IntArray

ByteArray = NDArray[np.uint8]
WordArray = NDArray[np.uint64]

EXTENDED = 0x8000_0000  # set in `FrameBlock.id` for 29-bit identifiers, as in a DBC file
BLOCK_FRAMES = 8192  # frames in a block: large enough for NumPy, small enough for flat memory


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """Data frames in the order of the recording; unused bytes of `data` are zero."""

    time: IntArray  # ns since epoch, shape (n,)
    id: NDArray[np.uint32]  # identifier, with EXTENDED, shape (n,)
    length: ByteArray  # bytes of data, 0..64, shape (n,)
    data: ByteArray  # shape (n, W), W = 8 (classic) or 64 (FD)


def id_text(frame_id: int) -> str:
    """The identifier as bus tools write it: 3 hexadecimal digits, or 8 when extended."""
    return f"0x{frame_id & 0x1FFFFFFF:08X}" if frame_id & EXTENDED else f"0x{frame_id:03X}"


def raw_bits(data: ByteArray, start: int, length: int, *, big_endian: bool) -> WordArray:
    """The unsigned integer of one signal in every frame, shape (n,).

    `start` is counted as in a DBC file: the least significant bit of a little-endian signal, the most
    significant bit (sawtooth numbering) of a big-endian one; `length` is 1..64 bits.  A signal touches at most
    nine bytes: eight are read as one word, a ninth is shifted in.
    """
    if data.shape[1] == 8 and data.flags.c_contiguous:  # a classic frame is one word
        if big_endian:
            last_bit = 8 * (start // 8) + 7 - start % 8 + length - 1
            return _masked(data.view(">u8")[:, 0].astype(np.uint64) >> np.uint64(63 - last_bit), length)
        return _masked(data.view("<u8")[:, 0] >> np.uint64(start), length)
    if big_endian:
        first_bit = 8 * (start // 8) + 7 - start % 8  # distance from the first bit on the wire
        last_bit = first_bit + length - 1
        first, last = first_bit // 8, last_bit // 8
        drop = 7 - last_bit % 8
        span = range(last, first - 1, -1)
    else:
        first, last = start // 8, (start + length - 1) // 8
        drop = start % 8
        span = range(first, last + 1)
    columns = [data[:, byte] for byte in span]  # least significant first
    word = np.zeros((len(data), 8), dtype=np.uint8)
    for place, column in enumerate(columns[:8]):
        word[:, place] = column
    bits = word.view("<u8")[:, 0].astype(np.uint64, copy=False) >> np.uint64(drop)
    if len(columns) == 9:
        bits |= columns[8].astype(np.uint64) << np.uint64(64 - drop)
    return _masked(bits, length)


def _masked(bits: WordArray, length: int) -> WordArray:
    return bits & np.uint64((1 << length) - 1)


def last_byte(start: int, length: int, *, big_endian: bool) -> int:
    """Index of the last byte that a signal touches."""
    if big_endian:
        return (8 * (start // 8) + 7 - start % 8 + length - 1) // 8
    return (start + length - 1) // 8
