"""MCAP containers: records, chunks and the summary, read so that damage costs as little as possible.

The `mcap` package gives up at the first damaged record and builds one Python object per message.  This reader
checks every chunk's CRC, passes over a chunk that fails, goes on at the next one, and hands out the messages of
a chunk together.  A chunk that is cut short is not used: its CRC cannot be checked.  The CRC of the whole data
section, where the writer stated one, is checked at its end.  Layout: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, Schema, Statistics

from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.inflate import ERRORS, Inflater

MAGIC = b"\x89MCAP0\r\n"
RECORD_SIZE_LIMIT = 1 << 28  # bytes of a record that is read; attachments are passed over and may be longer
PIECE = 1 << 20  # bytes read at once of skipped records
BATCH_MESSAGES = 4096  # messages outside chunks that are handed out together
DISORDER = 250_000_000  # ns that messages may lie back in time without being sorted; less than a window waits
PREFIX = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
CHUNK = struct.Struct("<QQQI")  # start, end, inflated size, CRC
FOOTER = struct.Struct("<QQI")  # summary start, summary offsets start, summary CRC
DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of the data section
READ = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA)
DAMAGED = "a damaged chunk"
UNREADABLE = (ValueError, struct.error, McapError)  # errors of the `mcap` package


@dataclass(slots=True)
class Messages:
    """The messages of one channel in one batch; `place` orders them among the batch's channels."""

    place: list[int] = field(default_factory=list)
    log_time: list[int] = field(default_factory=list)
    publish_time: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)


Batch = dict[int, Messages]  # by channel id


@dataclass(slots=True)
class Summary:
    """Summary section at the end of an intact file."""

    chunks: list[ChunkIndex] = field(default_factory=list)
    messages: int = 0
    data_crc: int = 0  # of the whole data section; 0: not stated
    starts: list[int] = field(default_factory=list)  # bytes at which chunks begin, in order


class McapFile:
    """`batches()` yields the messages chunk by chunk; `schemas` and `channels` fill as they are met."""

    def __init__(self, path: Path, account: Account) -> None:
        self.path = path
        self.account = account
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.time_ordered = True  # False: the index shows chunks that lie far back in time, known with the first batch
        self._counted = 0
        self._first_time = self._last_time = 0  # log times, ns
        self._unindexed = False  # the last chunk was damaged and its message indexes have not come yet
        self._inflater = Inflater(0)
        self._crc: int | None = None  # of the data section so far; None: there is none to compare it with

    def batches(self) -> Iterator[Batch]:
        """Batches in file order; raises UnreadableRecording when the file is no MCAP file."""
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UnreadableRecording(f"{self.path}: not an MCAP file (its first bytes are not the MCAP magic)")
            summary = self._summary(file)
            self.time_ordered = summary is None or _ordered(summary.chunks)
            self._inflater = Inflater(file.seek(0, 2))
            file.seek(len(MAGIC))
            yield from self._data_section(file, summary)
        if summary is not None and summary.messages > self._counted:
            self.account.corrupt(summary.messages - self._counted, f"in {DAMAGED}")

    def _data_section(self, file: BinaryIO, summary: Summary | None) -> Iterator[Batch]:
        size = file.seek(0, 2)
        file.seek(len(MAGIC))
        self._crc = zlib.crc32(MAGIC) if summary is not None and summary.data_crc else None
        loose = _Splitter(self)
        while True:
            at = file.tell()
            prefix = file.read(PREFIX.size)
            opcode, length = PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, 0)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                break
            longest = RECORD_SIZE_LIMIT if opcode in READ else size
            if opcode == 0 or length > min(longest, size - at - PREFIX.size):
                if not self._resume(file, at, summary, opcode):
                    break
                continue
            if opcode not in READ:
                self._pass_over(file, prefix, length)
                continue
            body = file.read(length)
            if self._crc is not None:
                self._crc = zlib.crc32(body, zlib.crc32(prefix, self._crc))
            if opcode == Opcode.CHUNK:
                yield from self._chunk(body)
            elif opcode == Opcode.MESSAGE:
                self._loose(loose, prefix + body)
                if loose.count >= BATCH_MESSAGES:
                    yield loose.take()
            else:
                self._record(opcode, body)
        if loose.count:
            yield loose.take()
        if self._crc is not None and summary is not None and self._crc != summary.data_crc:
            self.account.problem("the CRC of the data section is wrong: something outside the chunks is damaged")

    def _pass_over(self, file: BinaryIO, prefix: bytes, length: int) -> None:
        """Skip a record that is not needed (attachments may be long)."""
        if self._crc is None:
            file.seek(length, 1)
            return
        self._crc = zlib.crc32(prefix, self._crc)
        while length and (piece := file.read(min(length, PIECE))):
            self._crc = zlib.crc32(piece, self._crc)
            length -= len(piece)

    def _loose(self, loose: _Splitter, record: bytes) -> None:
        """A message outside the chunks."""
        try:
            loose.read(record)
        except UNREADABLE:
            self.count(1)
            self.account.corrupt(1, "a damaged message")

    def _chunk(self, body: bytes) -> Iterator[Batch]:
        splitter = _Splitter(self)
        self._unindexed = False
        try:
            splitter.read(self._inflate(body))
        except (*UNREADABLE, *ERRORS) as error:
            self.account.problem(f"a damaged chunk of {len(body)} bytes was passed over ({error})")
            self._unindexed = True
            return
        if splitter.count:
            yield splitter.take()

    def _inflate(self, body: bytes) -> bytes:
        """The records of a chunk, CRC checked; raises when it is wrong."""
        _, _, size, crc = CHUNK.unpack_from(body)
        name_length = struct.unpack_from("<I", body, CHUNK.size)[0]
        at = CHUNK.size + 4 + name_length
        compression = body[CHUNK.size + 4 : at].decode("ascii")
        packed = body[at + 8 :][: struct.unpack_from("<Q", body, at)[0]]
        data = self._inflater.inflate(compression, packed, size)
        if crc and zlib.crc32(data) != crc:
            raise ValueError("its CRC is wrong")
        return data

    def _record(self, opcode: int, body: bytes) -> None:
        """Records between chunks; a damaged one is passed over."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                self.channels[channel.id] = channel
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(_stream(body))
                if metadata.name == "recording" and "vehicle" in metadata.metadata:
                    self.account.vehicle = metadata.metadata["vehicle"]
            elif opcode == Opcode.MESSAGE_INDEX and self._unindexed:
                lost = (len(body) - 6) // 16  # channel id, byte length, then pairs of time and offset
                self.count(lost)
                self.account.corrupt(lost, f"in {DAMAGED}")
        except UNREADABLE as error:
            self.account.problem(f"a damaged record was passed over ({error})")

    def count(self, messages: int) -> None:
        """Messages that are in the account or will be put there by the receiver of the batch."""
        self._counted += messages

    def reached(self, first: int, last: int) -> None:
        """The recording has been read from `first` to `last` (log times)."""
        self._first_time = self._first_time or first
        self._last_time = max(self._last_time, last)

    def _resume(self, file: BinaryIO, at: int, summary: Summary | None, opcode: int) -> bool:
        """After a record that cannot be right: place the file at the next chunk of the index, if there is one."""
        self._crc = None  # the damage is reported already
        if summary is not None:
            later = bisect_right(summary.starts, at)
            found = later < len(summary.starts)
            self.account.problem(
                f"damaged at byte {at}; {'went on at the next chunk' if found else 'nothing after it'}"
            )
            if found:
                file.seek(summary.starts[later])
            return found
        inside = "inside a chunk" if opcode == Opcode.CHUNK else "before its end record"
        seconds = (self._last_time - self._first_time) / 1e9
        line = f"file ends {inside} after {seconds:.1f} s; {self._counted} messages recovered"
        self.account.problem(line)
        return False

    def _summary(self, file: BinaryIO) -> Summary | None:
        """The summary of a file that was closed properly and whose summary is undamaged, else None."""
        size = file.seek(0, 2)
        footer_at = size - len(MAGIC) - FOOTER.size - PREFIX.size
        if footer_at < len(MAGIC):
            return None
        file.seek(footer_at)
        tail = file.read()
        start, _, crc = FOOTER.unpack_from(tail, PREFIX.size)
        if not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER or not len(MAGIC) < start <= footer_at:
            return None
        file.seek(start)
        section = file.read(footer_at - start + PREFIX.size + FOOTER.size - 4)
        if crc and zlib.crc32(section) != crc:
            return None
        summary = Summary()
        file.seek(max(start - DATA_END.size, 0))
        end = file.read(DATA_END.size)
        if len(end) == DATA_END.size and end[0] == Opcode.DATA_END:
            summary.data_crc = DATA_END.unpack(end)[2]
        try:
            for opcode, body in _records(section[: footer_at - start]):
                if opcode == Opcode.CHUNK_INDEX:
                    summary.chunks.append(ChunkIndex.read(_stream(body)))
                elif opcode == Opcode.STATISTICS:
                    summary.messages = Statistics.read(_stream(body)).message_count
                else:
                    self._record(opcode, body)
        except UNREADABLE:
            return None
        summary.starts = sorted(index.chunk_start_offset for index in summary.chunks)
        return summary


class _Splitter:
    """Cuts a run of records into messages by channel."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.count = 0
        self.batch: Batch = {}

    def read(self, data: bytes) -> None:
        """Add all records of `data`; raises struct.error or ValueError when they do not fit into it."""
        position, total = 0, len(data)
        unpack, batch = MESSAGE.unpack_from, self.batch
        end = 0
        while position < total:
            if data[position] == Opcode.MESSAGE:
                _, length, channel, _, log_time, publish_time = unpack(data, position)
                if length < MESSAGE.size - PREFIX.size:
                    raise ValueError("a message shorter than its header")
                end = position + PREFIX.size + length
                messages = batch.get(channel)
                if messages is None:
                    messages = batch[channel] = Messages()
                messages.place.append(self.count)
                messages.log_time.append(log_time)
                messages.publish_time.append(publish_time)
                messages.data.append(data[position + MESSAGE.size : end])
                self.count += 1
            else:
                opcode, length = PREFIX.unpack_from(data, position)
                if opcode == 0:
                    raise ValueError("a record without a kind")
                end = position + PREFIX.size + length
                self.file._record(opcode, data[position + PREFIX.size : end])
            position = end
        if end > total:
            raise ValueError("its last record is cut")

    def take(self) -> Batch:
        self.file.count(self.count)
        times = [(messages.log_time[0], messages.log_time[-1]) for messages in self.batch.values()]
        self.file.reached(min(first for first, _ in times), max(last for _, last in times))
        batch, self.batch, self.count = self.batch, {}, 0
        return batch


def _ordered(chunks: list[ChunkIndex]) -> bool:
    """Whether every chunk begins about where the ones before it end."""
    newest = 0
    for index in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        if index.message_start_time < newest - DISORDER:
            return False
        newest = max(newest, index.message_end_time)
    return True


def _records(section: bytes) -> Iterator[tuple[int, bytes]]:
    position = 0
    while position + PREFIX.size <= len(section):
        opcode, length = PREFIX.unpack_from(section, position)
        position += PREFIX.size
        yield opcode, section[position : position + length]
        position += length


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
