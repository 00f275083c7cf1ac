"""Mutants of a file: damage that storage and radio do, and damage that somebody means."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable

import numpy as np
import zstandard

from sprung.replay.blf import CONTAINER, CONTAINER_TYPE, OBJECT_BASE
from sprung.replay.mcapfile import CHUNK, MAGIC, PREFIX

Random = np.random.Generator
MDF_BLOCK = re.compile(rb"##[A-Z]{2}\0{4}")
INTEGERS = [0, 1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**63, 2**64 - 1]
TOKENS = [
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e400",
        b"-1e30",
        b"1e999999999",
        b"9" * 40,
        b"9" * 400,
        b"-",
        b"--5",
        b"1_0",
        b"0x10",
    ),
    *(b"-9999", b"32767", b"99999999999999999999", b"1e-400", b"true", b"null", b'"', b"'", b"[" * 2000, b"{}", b"\0"),
    *(b"\n", b"\r", b",", b";", b"\t", b"#", b" ", b"\xff\xfe", b"\xef\xbb\xbf", b"\xd9\xa1\xd9\xa2", b"a" * 5000),
]


def mutant(data: bytes, rng: Random) -> bytes:
    """One to three mutations, most of them small."""
    for _ in range(int(rng.integers(1, 4))):
        if not data:
            return data
        change = MUTATIONS[int(rng.integers(len(MUTATIONS)))]
        data = change(bytearray(data), rng)
    return data


def _place(data: bytearray, rng: Random) -> int:
    """Anywhere, but headers more often than their share."""
    limit = min(len(data), 400) if rng.random() < 0.3 else len(data)
    return int(rng.integers(limit))


def _flip(data: bytearray, rng: Random) -> bytes:
    for _ in range(int(rng.integers(1, 5))):
        data[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _overwrite(data: bytearray, rng: Random) -> bytes:
    at, size = _place(data, rng), int(rng.integers(1, 64))
    data[at : at + size] = rng.bytes(len(data[at : at + size]))
    return bytes(data)


def _integer(data: bytearray, rng: Random) -> bytes:
    size = int(rng.choice([1, 2, 4, 8]))
    at = _place(data, rng)
    value = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << (8 * size))
    data[at : at + size] = value.to_bytes(size, "little" if rng.random() < 0.7 else "big")
    return bytes(data)


def _token(data: bytearray, rng: Random) -> bytes:
    at, token = _place(data, rng), TOKENS[int(rng.integers(len(TOKENS)))]
    data[at : at + int(rng.integers(0, len(token) + 1))] = token
    return bytes(data)


def _cut(data: bytearray, rng: Random) -> bytes:
    return bytes(data[: _place(data, rng)])


def _delete(data: bytearray, rng: Random) -> bytes:
    at = _place(data, rng)
    del data[at : at + int(rng.integers(1, 200))]
    return bytes(data)


def _repeat(data: bytearray, rng: Random) -> bytes:
    at, size = _place(data, rng), int(rng.integers(1, 400))
    data[at:at] = data[at : at + size] * int(rng.integers(1, 4))
    return bytes(data)


def _swap(data: bytearray, rng: Random) -> bytes:
    a, b, c, d = sorted(int(rng.integers(len(data) + 1)) for _ in range(4))
    return bytes(data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:])


def _line(data: bytearray, rng: Random) -> bytes:
    """Lines in another order, or one of them thousands of times."""
    lines = bytes(data).split(b"\n")
    a, b = int(rng.integers(len(lines))), int(rng.integers(len(lines)))
    if rng.random() < 0.2:
        lines[a:a] = [lines[b]] * int(rng.integers(1, 2000))
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


MUTATIONS: list[Callable[[bytearray, Random], bytes]] = [
    *(_flip, _flip, _overwrite, _integer, _integer, _token, _token, _cut, _delete, _repeat, _swap, _line)
]


def inside_mcap(data: bytes, rng: Random) -> bytes:
    """A mutation of what an MCAP chunk holds, packed again with the right size and CRC: nothing gives it away."""
    places = [at for at, opcode, _ in _mcap_records(data) if opcode == 6]
    if not places:
        return mutant(data, rng)
    at = places[int(rng.integers(len(places)))]
    length = PREFIX.unpack_from(data, at)[1]
    body = data[at + PREFIX.size : at + PREFIX.size + length]
    begin, end, size, _ = CHUNK.unpack_from(body)
    name = struct.unpack_from("<I", body, CHUNK.size)[0]
    packed = body[CHUNK.size + 4 + name + 8 :]
    inner = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    inner = mutant(inner, rng)
    packed = zstandard.compress(inner)
    head = CHUNK.pack(begin, end, len(inner), zlib.crc32(inner)) + struct.pack("<I", 4) + b"zstd"
    body = head + struct.pack("<Q", len(packed)) + packed
    return data[:at] + PREFIX.pack(6, len(body)) + body + data[at + PREFIX.size + length :]


def _mcap_records(data: bytes) -> list[tuple[int, int, int]]:
    found, at = [], len(MAGIC)
    while at + PREFIX.size <= len(data):
        opcode, length = PREFIX.unpack_from(data, at)
        found.append((at, opcode, length))
        at += PREFIX.size + length
    return found


def inside_blf(data: bytes, rng: Random) -> bytes:
    """The same for a BLF container."""
    containers = []
    at = 144
    while at + OBJECT_BASE.size <= len(data):
        signature, _, _, size, kind = OBJECT_BASE.unpack_from(data, at)
        if signature != b"LOBJ":
            break
        if kind == CONTAINER_TYPE:
            containers.append((at, size))
        at += size + size % 4
    if not containers:
        return mutant(data, rng)
    at, size = containers[int(rng.integers(len(containers)))]
    inner = zlib.decompress(data[at + OBJECT_BASE.size + CONTAINER.size : at + size])
    inner = mutant(inner, rng)
    body = CONTAINER.pack(2, len(inner)) + zlib.compress(inner)
    whole = OBJECT_BASE.pack(b"LOBJ", 16, 1, OBJECT_BASE.size + len(body), CONTAINER_TYPE) + body
    return data[:at] + whole + bytes(len(whole) % 4) + data[at + size + size % 4 :]


def inside_mf4(data: bytes, rng: Random) -> bytes:
    """Links of an MDF file that lead to another of its blocks, or back: nothing gives it away."""
    changed = bytearray(data)
    blocks = [found.start() for found in MDF_BLOCK.finditer(data)]
    links = [
        at + 24 + 8 * number
        for at in blocks
        for number in range(min(int.from_bytes(data[at + 16 : at + 24], "little"), 20))
    ]
    for _ in range(int(rng.integers(1, 4))):
        link = links[int(rng.integers(len(links)))]
        changed[link : link + 8] = blocks[int(rng.integers(len(blocks)))].to_bytes(8, "little")
    return bytes(changed)


INSIDE: dict[str, Callable[[bytes, Random], bytes]] = {"mcap": inside_mcap, "blf": inside_blf}
INSIDE |= {"mcap-protobuf": inside_mcap, "mcap-ros2": inside_mcap, "mf4": inside_mf4}
