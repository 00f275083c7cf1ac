"""Decompression with a hard bound, plausible for recordings, on the inflated size.

Every decompressor runs as a stream that is stopped one byte beyond the size that the container states, so a false
statement costs no more than the true size would.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import lz4.frame
import zstandard

LARGEST = 1 << 28  # bytes that one chunk or container may inflate to
ALWAYS = 1 << 22  # bytes that any chunk may inflate to, however small it is packed: usual chunks hold 1 MiB
RATIO = 500  # of inflated to packed bytes; constant signals with running time stamps reach about 50
FILE_ALWAYS = 1 << 28  # bytes that a file may inflate to in all, beside RATIO times its size
PIECE = 1 << 24  # bytes asked for at once: a buffer of the stated size is never made in advance

ERRORS = (ValueError, RuntimeError, MemoryError, zlib.error, zstandard.ZstdError)  # what damaged data may raise


class Inflater:
    """Inflates the chunks of one file of `file_size` bytes."""

    def __init__(self, file_size: int) -> None:
        self._left = FILE_ALWAYS + RATIO * file_size

    def inflate(self, method: str, packed: bytes, size: int) -> bytes:
        """`packed` inflated by "zstd", "lz4", "zlib" or "" (none), of exactly `size` bytes.

        Raises ValueError with the reason, or another of `ERRORS`.
        """
        if method == "":
            data = packed
        else:
            if method not in METHODS:
                raise ValueError(f"unknown compression {method!r}")
            if size > max(ALWAYS, min(LARGEST, RATIO * len(packed))):
                raise ValueError(f"{len(packed)} bytes are declared to inflate to {size}: not plausible")
            if size > self._left:
                raise ValueError("the file inflates to more than is plausible for its size")
            self._left -= size
            data = METHODS[method](packed, size)
        if len(data) != size:
            than = "more" if len(data) > size else "less"
            raise ValueError(f"it inflates to {than} than the {size} bytes it states")
        return data

    def beginning(self, packed: bytes, size: int) -> bytes:
        """What a zlib container that is cut short still gives, unchecked, at most `size` bytes."""
        size = min(size, ALWAYS, self._left)
        data = zlib.decompressobj().decompress(packed, size) if size else b""
        self._left -= len(data)
        return data


def _zstd(packed: bytes, size: int) -> bytes:
    reader = zstandard.ZstdDecompressor().stream_reader(packed)
    pieces = []
    wanted = size + 1
    while wanted and (piece := reader.read(min(wanted, PIECE))):
        pieces.append(piece)
        wanted -= len(piece)
    return b"".join(pieces)


def _lz4(packed: bytes, size: int) -> bytes:
    inflater = lz4.frame.LZ4FrameDecompressor()
    data: bytes = inflater.decompress(packed, max_length=size + 1)
    if not inflater.eof and len(data) <= size:
        raise ValueError("its compressed data are cut")
    return data


def _zlib(packed: bytes, size: int) -> bytes:
    inflater = zlib.decompressobj()
    data = inflater.decompress(packed, size + 1)
    if not inflater.eof and len(data) <= size:
        raise ValueError("its compressed data are cut")
    return data


METHODS: dict[str, Callable[[bytes, int], bytes]] = {"zstd": _zstd, "lz4": _lz4, "zlib": _zlib}
