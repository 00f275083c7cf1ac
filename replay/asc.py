"""Vector ASC logs, classic and FD frames, decimal or hexadecimal, absolute or relative time stamps.

python-can's ASCReader is the reference for the syntax; like it, this reader takes the date in the header for
local time, because the format has no time zone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from can.io.asc import ASCReader

from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.frames import FrameBlock
from sprung.replay.textframes import LineFrames, decimal_ns, frame_id, in_time, integer, line_batches, note_cut_frames

DATE = re.compile(rb"(?:date|Begin Trigger ?block)\s+\w+\s+(?P<date>.+)", re.IGNORECASE)
BASE = re.compile(rb"base\s+(?P<base>hex|dec)(?:\s+timestamps\s+(?P<stamps>absolute|relative))?", re.IGNORECASE)
EVENT = re.compile(rb"-?\d+\.\d+\s")
NO_FRAME = "other event"


class _Header:
    """Contents of the header lines read so far."""

    def __init__(self) -> None:
        self.start = 0  # ns since epoch
        self.base = 16
        self.relative = False
        self.dated = False

    def read(self, line: bytes, account: Account) -> None:
        if match := DATE.match(line):
            text = match["date"].decode("utf-8", errors="replace").strip()
            try:
                self.start = round(ASCReader._datetime_to_timestamp(text) * 1_000) * 1_000_000
                self.dated = True
            except ValueError:
                account.problem(f"date {text!r} in the ASC header cannot be read", incomplete=False)
        elif match := BASE.match(line):
            self.base = 16 if match["base"].lower() == b"hex" else 10
            self.relative = (match["stamps"] or b"").lower() == b"relative"


def frames(path: Path, account: Account) -> Iterator[FrameBlock]:
    """Blocks of some thousand frames; a frame's line that cannot be read is counted as corrupt."""
    header = _Header()
    clock = 0  # ns since the start, of the last event
    recognised = False
    for lines in line_batches(path):
        batch = LineFrames()
        damaged = 0
        for raw in lines:
            line = raw.strip()
            if not EVENT.match(line):
                recognised = recognised or bool(BASE.match(line) or DATE.match(line))
                header.read(line, account)
                continue
            try:
                stamp, frame = _event(line, header.base)
                clock = in_time(clock + stamp if header.relative else stamp)
                in_time(header.start + clock)
            except (ValueError, IndexError):
                damaged += 1
                continue
            if isinstance(frame, tuple):
                batch.add(header.start + clock, *frame)
            elif frame != NO_FRAME:
                account.foreign(1, frame)
        if not recognised and not batch.time:
            raise UnreadableRecording(f"{path}: no Vector ASC log (neither a header nor a frame was found)")
        note_cut_frames(lines, account)
        if damaged:
            account.corrupt(damaged, "line cannot be read")
            account.problem(f"{damaged} frames near {clock / 1e9:.3f} s cannot be read")
        if batch.time:
            yield batch.block(account)
    if not header.dated:
        account.problem("no date in the ASC header; times count from 1970", incomplete=False)


def _event(line: bytes, base: int) -> tuple[int, tuple[int, bytes] | str]:
    """Time stamp in ns, and (identifier, payload digits) or the reason why it is no data frame."""
    parts = line.split()
    stamp = decimal_ns(parts[0])
    if parts[1] == b"CANFD":
        return stamp, _fd_frame(parts, base)
    if not parts[1].isdigit() or len(parts) < 3:
        return stamp, NO_FRAME
    if parts[2].lower() == b"errorframe":
        return stamp, "error frame"
    if len(parts) < 5 or parts[3] not in (b"Rx", b"Tx", b"TxRq"):
        return stamp, NO_FRAME
    if parts[4] in (b"r", b"R"):
        return stamp, "remote frame"
    if parts[4] not in (b"d", b"D"):
        return stamp, NO_FRAME
    length = min(integer(parts[5], base), 8)
    return stamp, (_identifier(parts[2], base), _payload(parts[6 : 6 + length], length, base))


def _fd_frame(parts: list[bytes], base: int) -> tuple[int, bytes] | str:
    """CANFD channel direction id [name] brs esi dlc length data..."""
    if parts[4].lower() == b"errorframe":
        return "error frame"
    at = 5 if parts[5] in (b"0", b"1") else 6
    length = integer(parts[at + 3], 10)
    if length == 0:
        return "remote frame"
    data = parts[at + 4 : at + 4 + length]
    return _identifier(parts[4], base), _payload(data, length, base)


def _identifier(text: bytes, base: int) -> int:
    if text[-1:] in (b"x", b"X"):
        return frame_id(text[:-1], base, extended=True)
    return frame_id(text, base, extended=False)


def _payload(data: list[bytes], length: int, base: int) -> bytes:
    if len(data) < length:
        raise ValueError("fewer bytes than announced")
    if base == 10:
        return bytes(integer(byte, 10) for byte in data).hex().encode("ascii")
    joined = b"".join(data)
    if len(joined) != 2 * length:
        raise ValueError("half a byte")
    return joined
