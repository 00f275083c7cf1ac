"""Small files that somebody means: `python -m tests.fuzz.hostile FOLDER` writes them; tests/data/hostile holds them.

Each is as small as what it attacks needs, and holds, where that is its point, good samples beside the bad one.
"""

from __future__ import annotations

import json
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.writer import Writer

from sprung.replay.blf import CONTAINER, CONTAINER_TYPE, FILE_HEADER, OBJECT_BASE
from sprung.replay.mcapfile import MAGIC, PREFIX

START = 1_790_000_000
ROWS = 150
BAD = 70  # the row that is hostile


def chunk(method: str, packed: bytes, size: int) -> bytes:
    """An MCAP chunk record that states what it likes."""
    name = method.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return PREFIX.pack(Opcode.CHUNK, len(body)) + body


def container(packed: bytes, size: int) -> bytes:
    """A BLF log container that states what it likes."""
    body = CONTAINER.pack(2, size) + packed
    return OBJECT_BASE.pack(b"LOBJ", 16, 1, OBJECT_BASE.size + len(body), CONTAINER_TYPE) + body + bytes(len(body) % 4)


def blf(*parts: bytes) -> bytes:
    """A BLF file of these objects."""
    return FILE_HEADER.pack(b"LOGG", FILE_HEADER.size, *[0] * 28) + b"".join(parts)


def _mcap(folder: Path, name: str, bad: bytes | None = None, stamp: Callable[[int], int] | None = None) -> None:
    """One topic with a good message every 10 ms, but for the row `BAD`; `stamp` gives the publish times."""
    with (folder / name).open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Body", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/body/acceleration", "json", schema)
        for row in range(ROWS):
            log = START * 10**9 + row * 10**7
            data = json.dumps({"left": row % 7, "axes": [{}, {"right": row % 5}]}).encode()
            time = log if stamp is None else stamp(row)
            writer.add_message(channel, log, bad if row == BAD and bad is not None else data, time, row)
        writer.finish()


def _lines(folder: Path, name: str, bad: bytes) -> None:
    lines = [f"({START + row / 100:.6f}) can0 310#{row % 7:02X}00000000000000".encode() for row in range(ROWS)]
    lines[BAD] = bad
    (folder / name).write_bytes(b"\n".join(lines) + b"\n")


def _table(folder: Path, name: str, head: str, bad: str) -> None:
    rows = [f"{START + row / 100:.2f},{row % 7},{row % 5}" for row in range(ROWS)]
    rows[BAD] = bad
    (folder / name).write_text("\n".join([head, *rows]) + "\n")


def write(folder: Path) -> None:
    """All of them."""
    folder.mkdir(parents=True, exist_ok=True)
    bomb = bytes(1 << 25)
    for method, packed in (("zstd", zstandard.compress(bomb)), ("lz4", lz4.frame.compress(bomb[: 1 << 23]))):
        (folder / f"bomb-{method}.mcap").write_bytes(MAGIC + chunk(method, packed, 100))
    (folder / "bomb-stated.mcap").write_bytes(MAGIC + chunk("zstd", zstandard.compress(bomb), 1 << 30))
    (folder / "bomb.blf").write_bytes(blf(container(zlib.compress(bomb, 9), (1 << 32) - 1)))
    small = zstandard.compress(bytes(1 << 22))
    (folder / "bomb-many.mcap").write_bytes(MAGIC + 40 * chunk("zstd", small, 1 << 22))
    (folder / "signatures.blf").write_bytes(blf(b"LOBJ" * 3000))
    inner = 200 * OBJECT_BASE.pack(b"LOBJ", 16, 1, 16, 1)
    (folder / "short-objects.blf").write_bytes(blf(container(zlib.compress(inner), len(inner))))
    _mcap(folder, "nested.mcap", b"[" * 2_000)
    _mcap(folder, "int400.mcap", b'{"left": ' + b"1" * 400 + b', "axes": []}')
    _mcap(folder, "1e300.mcap", b'{"left": 1e300, "axes": [{}, {"right": -1e999}]}')
    _mcap(folder, "sentinel.mcap", b'{"left": -9999, "axes": [{}, {"right": 32767}]}')
    _mcap(folder, "same-time.mcap", stamp=lambda row: START * 10**9)
    _mcap(folder, "apart.mcap", stamp=lambda row: (START + 1000 * row) * 10**9)
    _mcap(folder, "eras.mcap", stamp=lambda row: (START + row % 2 * 10**9) * 10**9 + row * 10**7)
    _mcap(folder, "no-clock.mcap", stamp=lambda row: (1 << 64) - 1 - row)
    _lines(folder, "time.log", b"(99999999999999.0) can0 310#00")
    _lines(folder, "identifier.log", b"(1790000000.7) can0 123456789ABC#00")
    _lines(folder, "digits.log", "(\u0661\u0662.0) can0 310#00".encode())
    _lines(folder, "long-line.log", b"(1790000000.7) can0 310#" + b"0" * 20_000)
    _table(folder, "inf.csv", "time,left,right", f"{START + 0.7},inf,-1e999")
    _table(folder, "time.csv", "time,left,right", "1e300,1,1")
    _table(folder, "field.csv", "time,left,right", f"{START + 0.7}," + "1" * 20_000 + ",1")
    (folder / "columns.csv").write_text("time," + ",".join("a" for _ in range(12_000)) + "\n1,2\n")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
