"""Vector BLF: log containers inflated one by one, their CAN objects read in columns.

python-can makes one Python object per frame, which alone would take most of the time of a replay; its BLF
writer and reader are the reference for the layout (and that of Toby Lorenz' vector_blf).  Objects other than CAN
messages (markers, statistics, other buses) are not messages and are passed over.
"""

from __future__ import annotations

import datetime
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import IntArray
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.frames import ByteArray, FrameBlock
from sprung.replay.inflate import ERRORS, Inflater

IndexArray = NDArray[np.intp]

FILE_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
OBJECT_BASE = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, type
CONTAINER = struct.Struct("<H6xL4x")  # compression, inflated size
CONTAINER_TYPE, ERROR_TYPES = 10, (2, 73, 104)
CLASSIC_TYPES, FD_TYPE, FD64_TYPE = (1, 86), 100, 101
HEADER_BYTES = {1: 32, 2: 40}  # base and rest, by header version
TEN_MICROSECONDS = 1  # value of the object's flags: the time stamp counts 10 us, else 1 ns
LARGEST_OBJECT = 1 << 28  # bytes of an object in the file
LARGEST_INSIDE = 1 << 22  # bytes of an object inside a container; one of a CAN bus has about a hundred
FIRST_LOOK, LAST_LOOK = 1 << 8, 1 << 20  # bytes in which the next object is looked for, doubled from look to look
FIXED = {"classic": 8, "fd": 20, "fd64": 40}  # bytes of a message before its data
LATEST = np.iinfo(np.int64).max
ODD_STOP = 86_400.0  # s between the last frame and the stop time in the header, beyond which one of them is wrong
BATCH_BYTES = 1 << 19  # of inflated objects that are read together


def frames(path: Path, account: Account) -> Iterator[FrameBlock]:
    """Blocks of one container each; damage is skipped and put into the account."""
    with path.open("rb") as file:
        header = file.read(FILE_HEADER.size)
        if len(header) < FILE_HEADER.size or header[:4] != b"LOGG":
            raise UnreadableRecording(f"{path}: not a BLF file (it does not begin with LOGG)")
        fields = FILE_HEADER.unpack(header)
        file.seek(fields[1])
        reader = _Objects(_system_time(fields[14:22], account), account)
        for data in _containers(file, path.stat().st_size, account):
            yield from reader.read(data)
    yield from reader.flush()
    _check_stop(reader, fields[22:30], account)
    if reader.tail.strip(b"\0"):
        account.problem(f"file ends inside an object after {reader.seconds:.1f} s; everything before was read")
    expected = fields[12]  # number of objects that the writer counted; 0 when it did not finish
    if account.incomplete and expected > reader.objects:
        account.corrupt(expected - reader.objects, "in a part of the file that cannot be read")


def _containers(file: BinaryIO, file_size: int, account: Account) -> Iterator[bytes | None]:
    """Inflated containers in file order; None where something is missing between two of them."""
    inflater = Inflater(file_size)
    while base := file.read(OBJECT_BASE.size):
        if len(base) < OBJECT_BASE.size:
            account.problem("file ends inside a container header; everything before was read")
            return
        at = file.tell() - OBJECT_BASE.size
        signature, _, _, size, kind = OBJECT_BASE.unpack(base)
        if signature != b"LOBJ" or not OBJECT_BASE.size <= size <= LARGEST_OBJECT:
            account.problem(f"no object at byte {at}: damaged; reading goes on at the next one")
            yield None
            if not _seek_object(file, at + 1):
                return
            continue
        body = file.read(size - OBJECT_BASE.size)
        cut = len(body) < size - OBJECT_BASE.size
        if cut and (later := _next_container(body)) is not None:  # the size is wrong, not the file's end
            account.problem(f"the object at byte {at} has an impossible length of {size} bytes: damaged")
            yield None
            file.seek(at + OBJECT_BASE.size + later)
            continue
        file.read(size % 4)
        if cut:
            account.problem("file ends inside a container; everything before was read")
        if kind != CONTAINER_TYPE:
            yield base + body
        elif len(body) >= CONTAINER.size:
            yield _inflate(body, cut, inflater, account)


def _inflate(body: bytes, cut: bool, inflater: Inflater, account: Account) -> bytes | None:
    """The objects of a container, checksum verified unless the file is cut in it; None when it is damaged."""
    method, size = CONTAINER.unpack_from(body)
    packed = body[CONTAINER.size :]
    if method == 0:
        return packed
    if method != 2:
        account.problem(f"a container with unknown compression {method} was passed over")
        return None
    try:
        return inflater.beginning(packed, size) if cut else inflater.inflate("zlib", packed, size)
    except ERRORS as error:
        account.problem(f"a damaged container of {size} bytes was passed over ({error})")
    return None


def _next_container(body: bytes) -> int | None:
    """Where in `body` a container begins that ends in it, too."""
    found = body.find(b"LOBJ")
    while 0 <= found <= len(body) - OBJECT_BASE.size:
        _, _, _, size, kind = OBJECT_BASE.unpack_from(body, found)
        if kind == CONTAINER_TYPE and OBJECT_BASE.size <= size <= len(body) - found:
            return found
        found = body.find(b"LOBJ", found + 4)
    return None


def _seek_object(file: BinaryIO, position: int) -> bool:
    """Place the file at the next object's signature."""
    look = FIRST_LOOK
    file.seek(position)
    while block := file.read(look):
        found = block.find(b"LOBJ")
        if found >= 0:
            file.seek(position + found)
            return True
        if len(block) < look:
            return False
        position += len(block) - 3
        look = min(2 * look, LAST_LOOK)
        file.seek(position)
    return False


def _check_stop(reader: _Objects, fields: tuple[int, ...], account: Account) -> None:
    """The header has no checksum; start and stop in it and the frames' own times show whether they are consistent."""
    stop = _moment(fields)
    if not stop or not reader.start or not reader.objects:
        return
    apart = (stop - reader.start) / 1e9 - reader.seconds
    if not -1.0 <= apart <= ODD_STOP:
        account.problem("start, stop and length of the recording disagree in the BLF header; its date may be wrong")


class _Objects:
    """Cuts inflated data into objects; one that straddles two containers waits in `tail`."""

    def __init__(self, start: int, account: Account) -> None:
        self.start = start  # ns since epoch
        self.account = account
        self.tail = b""
        self._pieces: list[bytes] = []  # not yet joined to the tail
        self._waiting = 0  # bytes in them
        self.objects = 0
        self.seconds = 0.0  # last time seen, since the start of the measurement

    def read(self, data: bytes | None) -> Iterator[FrameBlock]:
        if data is None:  # the rest of a straddling object is lost
            yield from self.flush()
            self.tail = b""
            return
        self._pieces.append(data)
        self._waiting += len(data)
        if self._waiting >= BATCH_BYTES:
            yield from self.flush()

    def flush(self) -> Iterator[FrameBlock]:
        """The objects that are whole; an unfinished one stays in `tail`."""
        data = b"".join([self.tail, *self._pieces])
        self._pieces, self._waiting = [], 0
        offsets, kinds, end = self._walk(data)
        self.tail = data[end:]
        if not len(offsets):
            return
        self.objects += len(offsets)
        octets = np.frombuffer(data, dtype=np.uint8)
        block = _columns(octets, offsets, kinds, self.start, self.account)
        if block is not None:
            self.seconds = max(self.seconds, (int(block.time.max()) - self.start) / 1e9)
            yield block

    def _walk(self, data: bytes) -> tuple[IndexArray, IntArray, int]:
        """Offsets and types of the whole objects, and where the unfinished rest begins."""
        runs: list[tuple[IndexArray, int]] = []
        total, position, end = len(data), 0, 0
        while position + OBJECT_BASE.size <= total:
            found = data.find(b"LOBJ", position, position + 8)
            if found < 0:
                found = data.find(b"LOBJ", position)
                if runs:
                    self.account.problem("a damaged object inside a container was passed over")
                if found < 0:
                    end = total
                    break
            end = found
            if found + OBJECT_BASE.size > total:
                break
            _, _, _, size, kind = OBJECT_BASE.unpack_from(data, found)
            if not OBJECT_BASE.size <= size <= LARGEST_INSIDE:
                position = found + 4
                continue
            if found + size > total:
                break
            count = _alike(data, found, size)
            runs.append((found + size * np.arange(count), kind))
            position = end = found + size * count
        if not runs:
            return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.int64), end
        offsets = np.concatenate([run for run, _ in runs])
        return offsets, np.repeat([kind for _, kind in runs], [len(run) for run, _ in runs]), end


def _alike(data: bytes, offset: int, size: int) -> int:
    """Number of objects of the same size and type that follow each other from `offset` on; at least 1."""
    count, most = 1, (len(data) - offset) // size if size % 4 == 0 else 1
    while count < most:  # in growing steps, so that mixed objects cost little
        reach = min(4 * count, most)
        words = np.frombuffer(data, "<u4", reach * size // 4, offset).reshape(reach, -1)
        same = (words[:, 0] == words[0, 0]) & (words[:, 2] == words[0, 2]) & (words[:, 3] == words[0, 3])
        run = reach if same.all() else int(np.argmin(same))
        if run < reach:
            return run
        count = reach
    return count


def _columns(
    octets: ByteArray, offsets: IndexArray, kinds: IntArray, start: int, account: Account
) -> FrameBlock | None:
    account.foreign(int(np.isin(kinds, ERROR_TYPES).sum()), "error frame")
    is_classic, is_fd, is_fd64 = np.isin(kinds, CLASSIC_TYPES), kinds == FD_TYPE, kinds == FD64_TYPE
    message = is_classic | is_fd | is_fd64
    if not message.any():
        return None
    offsets, is_fd, is_fd64 = offsets[message], is_fd[message], is_fd64[message]
    version, size = _field(octets, offsets + 6, "<u2"), _field(octets, offsets + 8, "<u4")
    header = np.where(version == 2, HEADER_BYTES[2], HEADER_BYTES[1])
    fixed = np.where(is_fd, FIXED["fd"], np.where(is_fd64, FIXED["fd64"], FIXED["classic"]))
    whole = size >= header + fixed
    account.corrupt(int((~whole).sum()), "object shorter than its message")
    offsets, is_fd, is_fd64 = offsets[whole], is_fd[whole], is_fd64[whole]
    body, payload, end = (offsets + header[whole]), (offsets + (header + fixed)[whole]), (offsets + size[whole])
    length = np.where(is_fd, octets[body + np.where(is_fd, 14, 0)], octets[body + np.where(is_fd64, 2, 3)])
    length = np.minimum(length, np.where(is_fd | is_fd64, 64, 8)).astype(np.uint8)
    ticks = _field(octets, offsets + 24, "<u8")
    unit = np.where(_field(octets, offsets + 16, "<u4") == TEN_MICROSECONDS, np.uint64(10_000), np.uint64(1))
    timely = ticks <= np.uint64(LATEST - start) // unit
    inside = payload + length <= end
    identifier = _field(octets, body + 4, "<u4") & np.uint32(0x9FFFFFFF)
    remote = octets[body + np.where(is_fd64, 12, 2)] & np.where(is_fd64, 0x10, 0x80).astype(np.uint8) != 0
    account.foreign(int(remote.sum()), "remote frame")
    account.corrupt(int((~remote & ~inside).sum()), "object shorter than its message")
    account.corrupt(int((~remote & inside & ~timely).sum()), "time stamp out of range")
    keep = ~remote & inside & timely
    if not keep.any():
        return None
    time = start + (ticks[keep] * unit[keep]).astype(np.int64)
    data = _payloads(octets, payload[keep], length[keep], 64 if (is_fd | is_fd64).any() else 8)
    return FrameBlock(time, identifier[keep], length[keep], data)


def _payloads(octets: ByteArray, payload: IndexArray, length: ByteArray, width: int) -> ByteArray:
    """Data of the messages, zero beyond their length, shape (n, width)."""
    data = np.zeros((len(payload), width), dtype=np.uint8)
    columns = np.arange(width)
    inside = columns < length[:, None]
    index = np.minimum(payload[:, None] + columns, len(octets) - 1)
    data[inside] = octets[index][inside]
    return data


def _field(octets: ByteArray, offsets: IndexArray, dtype: str) -> NDArray[np.unsignedinteger]:
    size = np.dtype(dtype).itemsize
    return np.ascontiguousarray(octets[offsets[:, None] + np.arange(size)]).view(dtype)[:, 0]


def _moment(fields: tuple[int, ...]) -> int:
    """Windows SYSTEMTIME (UTC) as ns since epoch; 0 when it is empty or none."""
    year, month, _, day, hour, minute, second, milli = fields
    try:
        moment = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.UTC)
    except ValueError:
        return 0
    whole = int(moment.timestamp()) * 1_000_000_000 + milli * 1_000_000
    return whole if 0 <= whole < LATEST // 2 else 0


def _system_time(fields: tuple[int, ...], account: Account) -> int:
    """Start of the measurement in ns since epoch; 0 when the writer left it empty."""
    start = _moment(fields)
    if not start:
        account.problem("no start time in the BLF header; times count from 1970", incomplete=False)
    return start
