"""Linux can-utils `candump -l` logs: `(seconds.micros) interface ID#DATA`, FD as `ID##FDATA`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.frames import FrameBlock
from sprung.replay.textframes import LineFrames, decimal_ns, frame_id, integer, line_batches, note_cut_frames

ERROR_FLAG = 0x2000_0000


def frames(path: Path, account: Account) -> Iterator[FrameBlock]:
    """Blocks of some thousand frames; lines that are no frames are counted as corrupt."""
    first = True
    for lines in line_batches(path):
        batch = LineFrames()
        damaged = 0
        for line in lines:
            parts = line.split()
            if not parts:
                continue
            try:
                frame = _frame(parts)
            except (ValueError, IndexError):
                damaged += 1
                continue
            if isinstance(frame, str):
                account.foreign(1, frame)
            else:
                batch.add(*frame)
        if first and not batch.time and damaged:
            raise UnreadableRecording(f"{path}: no candump log (a line reads `(seconds) interface ID#DATA`)")
        first = False
        if damaged:
            account.corrupt(damaged, "line is no frame")
            account.problem(f"{damaged} lines near {_near(batch)} are no frames")
        note_cut_frames(lines, account)
        if batch.time:
            yield batch.block(account)


def _frame(parts: list[bytes]) -> tuple[int, int, bytes] | str:
    """(time, identifier, payload digits) of one line, or the reason why it is no data frame."""
    stamp, body = parts[0], parts[2]
    if stamp[:1] != b"(" or stamp[-1:] != b")":
        raise ValueError("no time stamp")
    time = decimal_ns(stamp[1:-1])
    identifier, separator, payload = body.partition(b"#")
    if not separator:
        raise ValueError("no frame")
    extended = len(identifier) > 3  # can-utils writes 3 digits or 8
    if extended and integer(identifier, 16) >> 29 == ERROR_FLAG >> 29:
        return "error frame"
    number = frame_id(identifier, 16, extended=extended)
    if payload[:1] == b"#":
        payload = payload[2:]
    elif payload[:1] in (b"R", b"r"):
        return "remote frame"
    elif len(payload) > 16:
        payload = payload[:16] if payload[16:17] == b"_" else payload  # can-utils' `_` before a raw DLC
    if len(payload) % 2 or len(payload) > 128:
        raise ValueError("half a byte")
    return time, number, payload


def _near(batch: LineFrames) -> str:
    return f"{batch.time[-1] / 1e9:.3f} s" if batch.time else "the start of the file"
