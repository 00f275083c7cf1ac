"""Sizes that a file declares, checked before it is read: values implausible for its length are refused.

Packages of others read whole series, make room for what a file states, and inflate what is packed without asking.  Here
are the bounds for all of them, and the sizes that MATLAB and MDF files state, without more than a piece in memory.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from sprung.replay.account import UnreadableRecording
from sprung.replay.inflate import LARGEST, PIECE

SAMPLES_ALWAYS, SAMPLES_PER_BYTE = 10_000_000, 100  # that a file may give; well packed ones give about 5 a byte
WHOLE_ALWAYS, WHOLE_RATIO = 1 << 28, 100  # bytes that a file which is read whole may unpack to, and times its size
FOR_ITS_SIZE = "a file of its size can hold"
MATRIX, COMPRESSED = 14, 15  # miMATRIX, and a variable in zlib's format (MATLAB's "MAT-File Format", table 1-1)
SMALL = 1 << 16  # a kind from this on has its size beside it, and its value in the tag
DEEPEST_ARRAY = 500  # arrays inside each other; SciPy takes some thousands
MAT_HEADER = 128
MDF_BLOCKS = re.compile(rb"##(?:DZ|CG)\0{4}")
MDF_ZIPPED = struct.Struct(
    "<4s4xQQ2sBxIQQ"
)  # id, length, links, of which block, method, parameter, bytes, packed bytes
MDF_GROUP = struct.Struct("<4s4xQQ48xQQHH4xII")  # id, length, links, record id, records, flags, -, bytes, further bytes
READ = 1 << 20  # bytes of packed data that are looked at at once
MDF_HEADER, MDF_FIRST_LINK = 64, 24  # where the header block lies, and its links in any block
MDF_LINK = struct.Struct("<Q")
MDF_LINKS: dict[str, tuple[tuple[int, str], ...]] = {  # of a kind of block: number of the link, and to what kind
    "header": ((0, "DG"), (1, "listed"), (3, "listed"), (4, "listed")),  # groups; history, attachments, events
    "listed": ((0, "listed"),),
    "DG": ((0, "DG"), (1, "CG"), (2, "data")),
    "CG": ((0, "CG"), (1, "CN")),
    "CN": ((0, "CN"), (1, "composition"), (5, "data")),
}
MDF_PARTS = {b"##CN": "CN", b"##CA": "listed"}  # what a channel may be composed of
MDF_LISTS = (b"##HL", b"##DL", b"##LD")  # what data may be listed in
VARIABLE = 1  # flag of a group whose records have lengths of their own


def most_samples(path: Path) -> int:
    """How many samples a file may give."""
    return SAMPLES_ALWAYS + SAMPLES_PER_BYTE * path.stat().st_size


def check_samples(path: Path, stated: int) -> None:
    """Raise UnreadableRecording when a file states more values than it can hold."""
    if stated > most_samples(path):
        raise UnreadableRecording(f"{path}: states {stated} values, more than {FOR_ITS_SIZE}")


def check_piece(path: Path, name: str, size: int) -> None:
    """Raise UnreadableRecording when what must be unpacked at once, of a file, is too much."""
    if size > LARGEST:
        raise UnreadableRecording(f"{path}: {name} is stored in pieces of {size >> 20} MB, too large to be unpacked")


def check_whole(path: Path, sizes: Iterator[int]) -> None:
    """Raise UnreadableRecording when the parts of a file that is read whole are too much together."""
    most, total = WHOLE_ALWAYS + WHOLE_RATIO * path.stat().st_size, 0
    for size in sizes:
        total += size
        if total > most:
            raise UnreadableRecording(f"{path}: unpacks to more than {total >> 20} MB, more than {FOR_ITS_SIZE}")


def mat_sizes(path: Path) -> Iterator[int]:
    """Bytes that the compressed variables of a MATLAB file (version 5) inflate to, piece by piece.

    Raises UnreadableRecording for structures and cells so deep inside each other that SciPy runs out of stack, and the
    process ends with it.
    """
    with path.open("rb") as file:
        head = file.read(MAT_HEADER)
        order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
        if order is None:  # version 4: nothing is packed
            return
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(order + "II", tag)
            nesting = _Nesting(path, order)
            if kind == COMPRESSED:
                for piece in _inflated(_pieces(file, size)):
                    nesting.feed(piece)
                    yield len(piece)
            else:
                nesting.feed(tag)
                for piece in _pieces(file, size):
                    nesting.feed(piece)


class _Nesting:
    """Follows the elements of one variable of a MATLAB file."""

    def __init__(self, path: Path, order: str) -> None:
        """order: of bytes, as `struct` writes it."""
        self._path = path
        self._tag = struct.Struct(order + "II")
        self._held = b""  # of a tag that has not come whole
        self._left = 0  # bytes of an element that is not looked into
        self._at = 0
        self._ends: list[int] = []  # of the arrays that this place is inside of

    def feed(self, piece: bytes) -> None:
        """The next bytes."""
        data, i = self._held + piece, 0
        while True:
            passed = min(self._left, len(data) - i)
            i, self._left = i + passed, self._left - passed
            if self._left or len(data) - i < self._tag.size:
                break
            at = self._at + i
            while self._ends and at >= self._ends[-1]:
                self._ends.pop()
            kind, size = self._tag.unpack_from(data, i)
            i += self._tag.size
            if kind == MATRIX:
                self._ends.append(at + self._tag.size + size)
                if len(self._ends) > DEEPEST_ARRAY:
                    raise UnreadableRecording(f"{self._path}: arrays lie more than {DEEPEST_ARRAY} deep in each other")
            elif kind < SMALL:  # else its value stands in the tag
                self._left = size + -size % 8
        self._held, self._at = data[i:], self._at + i


def mdf_sizes(path: Path) -> Iterator[int]:
    """Bytes that the packed blocks of an MDF 4 file inflate to, piece by piece, and those that its groups state.

    Blocks are found by their names wherever they stand, so that a damaged chain hides none.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in MDF_BLOCKS.finditer(data):
            at = found.start()
            if data[at : at + 4] == b"##CG" and at + MDF_GROUP.size <= len(data):
                _, length, links, _, records, flags, _, size, further = MDF_GROUP.unpack_from(data, at)
                if (length, links) == (MDF_GROUP.size, 6) and not flags & VARIABLE:
                    yield records * (size + further)
            elif at + MDF_ZIPPED.size <= len(data):
                _, length, links, _, _, _, _, packed = MDF_ZIPPED.unpack_from(data, at)
                if links == 0 and length == MDF_ZIPPED.size + packed:
                    begin = at + MDF_ZIPPED.size
                    ends = range(begin, begin + packed, READ)
                    yield from map(len, _inflated(data[a : min(a + READ, begin + packed)] for a in ends))


def check_mdf_links(path: Path) -> None:
    """Raise UnreadableRecording for an MDF 4 file of which two blocks, or one and itself, lead to the same next one.

    asammdf follows lists of blocks to their end, wherever they lead: in a circle it would go on for ever.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        waiting, reached = [(MDF_HEADER, "header")], {MDF_HEADER}
        while waiting:
            at, kind = waiting.pop()
            for number, to in MDF_LINKS[kind]:
                link = at + MDF_FIRST_LINK + 8 * number
                if link + MDF_LINK.size > len(data):
                    continue
                (target,) = MDF_LINK.unpack_from(data, link)
                role = _role(to, data[target : target + 4])
                if not 0 < target < len(data) or role is None:
                    continue
                if target in reached:
                    raise UnreadableRecording(
                        f"{path}: damaged: its blocks lead to byte {target} twice, so that reading would not end"
                    )
                reached.add(target)
                waiting.append((target, role))


def _role(to: str, name: bytes) -> str | None:
    """What a block is read as, that is linked to as `to`; None where it leads nowhere."""
    if to == "composition":
        return MDF_PARTS.get(name)
    if to == "data":
        return "listed" if name in MDF_LISTS else None
    return to


def _pieces(file: BinaryIO, size: int) -> Iterator[bytes]:
    while size > 0 and (piece := file.read(min(size, READ))):
        size -= len(piece)
        yield piece


def _inflated(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """What zlib data inflate to, until they end or are damaged."""
    inflater = zlib.decompressobj()
    try:
        for piece in pieces:
            left = piece
            while left and not inflater.eof:
                yield inflater.decompress(left, PIECE)
                left = inflater.unconsumed_tail
            if inflater.eof:
                return
    except zlib.error:
        return
