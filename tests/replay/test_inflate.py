"""Decompression never gives more than the container states, nor more than is plausible."""

import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from sprung.replay.account import Account
from sprung.replay.blf import CONTAINER, FILE_HEADER, OBJECT_BASE, frames
from sprung.replay.inflate import ALWAYS, ERRORS, FILE_ALWAYS, LARGEST, RATIO, Inflater
from sprung.replay.mcapfile import MAGIC, PREFIX, McapFile

PACK = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "zlib": zlib.compress}
DATA = np.random.default_rng(1).bytes(3_000) * 50


def chunk(method: str, packed: bytes, size: int, crc: int = 0) -> bytes:
    """A chunk record that says what it likes."""
    name = method.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return PREFIX.pack(Opcode.CHUNK, len(body)) + body


def container(packed: bytes, size: int) -> bytes:
    """A BLF log container that says what it likes."""
    body = CONTAINER.pack(2, size) + packed
    return OBJECT_BASE.pack(b"LOBJ", 16, 1, OBJECT_BASE.size + len(body), 10) + body + bytes(len(body) % 4)


@pytest.mark.parametrize("method", PACK)
def test_what_was_packed_comes_back(method: str) -> None:
    assert Inflater(0).inflate(method, PACK[method](DATA), len(DATA)) == DATA
    assert Inflater(0).inflate(method, PACK[method](b""), 0) == b""


@pytest.mark.parametrize("method", PACK)
@pytest.mark.parametrize("stated", [0, 1, len(DATA) - 1, len(DATA) + 1])
def test_another_size_than_the_stated_one_is_refused(method: str, stated: int) -> None:
    with pytest.raises(ValueError, match="states"):
        Inflater(0).inflate(method, PACK[method](DATA), stated)


@pytest.mark.parametrize("method", PACK)
def test_cut_data_are_refused(method: str) -> None:
    packed = PACK[method](DATA)
    for size in (0, 1, 10, len(packed) // 2, len(packed) - 1):
        with pytest.raises(ERRORS):
            Inflater(0).inflate(method, packed[:size], len(DATA))


@pytest.mark.parametrize("method", PACK)
def test_a_bomb_costs_neither_time_nor_memory(method: str) -> None:
    bomb = PACK[method](bytes(1 << 25))
    tracemalloc.start()
    started = time.process_time()
    for stated in (100, 1 << 27, LARGEST + 1, (1 << 64) - 1):
        if stated > max(ALWAYS, RATIO * len(bomb)) or stated < len(bomb):
            with pytest.raises(ValueError, match=r"states|plausible"):
                Inflater(0).inflate(method, bomb, stated)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - started < 2.0
    assert peak < 8 << 20


def test_many_small_bombs_are_one_large_one() -> None:
    inflater = Inflater(file_size=100_000)
    packed = zlib.compress(bytes(ALWAYS))
    with pytest.raises(ValueError, match="in"):
        for _ in range((FILE_ALWAYS + RATIO * 100_000) // ALWAYS + 1):
            inflater.inflate("zlib", packed, ALWAYS)


@pytest.mark.parametrize("method", ["zstd", "lz4"])
@pytest.mark.parametrize("stated", [100, 1 << 30, (1 << 64) - 1])
def test_an_mcap_bomb_is_a_damaged_chunk(method: str, stated: int, tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + chunk(method, PACK[method](bytes(1 << 25)), stated))
    account = Account()
    started = time.process_time()
    assert list(McapFile(path, account).batches()) == []
    assert time.process_time() - started < 2.0
    assert account.incomplete
    assert any("damaged chunk" in line for line in account.problems)


def test_a_chunk_of_nothing_is_not_walked_through_record_by_record(tmp_path: Path) -> None:
    path = tmp_path / "zeros.mcap"
    path.write_bytes(MAGIC + 20 * chunk("zstd", zstandard.compress(bytes(ALWAYS)), ALWAYS))
    account = Account()
    started = time.process_time()
    assert list(McapFile(path, account).batches()) == []
    assert time.process_time() - started < 4.0
    assert "without a kind" in account.problems[0]


@pytest.mark.parametrize("stated", [100, 1 << 27, (1 << 32) - 1])
def test_a_blf_bomb_is_a_damaged_container(stated: int, tmp_path: Path) -> None:
    path = tmp_path / "bomb.blf"
    header = FILE_HEADER.pack(b"LOGG", FILE_HEADER.size, *[0] * 28)
    path.write_bytes(header + container(zlib.compress(bytes(1 << 25)), stated))
    account = Account()
    started = time.process_time()
    assert list(frames(path, account)) == []
    assert time.process_time() - started < 2.0
    assert account.incomplete
    assert "container" in account.problems[-1]
