"""Files that unpack to, or state, more than they can hold are refused before anything is read."""

from __future__ import annotations

import re
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from sprung.replay import UnreadableRecording, bounds, open_recording
from tests.fuzz.seeds import GROUPED, SEEDS, TABLE
from tests.replay_files import database

MEGABYTE = 1 << 20


def refused(path: Path) -> str:
    with pytest.raises(UnreadableRecording) as caught:
        list(open_recording(path, GROUPED if path.suffix == ".tdms" else TABLE, dbc=database()).blocks())
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds so low that files of a test reach them."""
    monkeypatch.setattr(bounds, "WHOLE_ALWAYS", MEGABYTE)
    monkeypatch.setattr(bounds, "LARGEST", MEGABYTE)
    monkeypatch.setattr(bounds, "SAMPLES_ALWAYS", 100)
    monkeypatch.setattr(bounds, "SAMPLES_PER_BYTE", 0)


def test_a_table_of_a_billion_rows_that_were_never_written_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("time", "left", "right"):
            file.create_dataset(name, (10**12,), "f8", chunks=(1000,))
    assert "states 2000000000000 values" in refused(tmp_path / "a.h5")


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("levels", "order"), [(100, "<"), (20_000, "<"), (20_000, ">")])
def test_arrays_of_matlab_thousands_of_levels_inside_each_other_are_refused(
    tmp_path: Path, levels: int, order: str, packed: bool
) -> None:
    """SciPy runs out of stack with them, and the process ends."""

    def element(kind: int, value: bytes) -> bytes:
        return struct.pack(f"{order}II", kind, len(value)) + value + bytes(-len(value) % 8)

    def array(kind: int, rows: int) -> bytes:
        name = struct.pack(f"{order}I4s", 2 << 16 | 1, b"ab\0\0")  # a small element: its size beside its kind
        sizes = element(6, struct.pack(f"{order}II", kind, 0)) + element(5, struct.pack(f"{order}ii", rows, 1))
        return sizes + name

    inner = array(6, 100) + element(9, struct.pack(f"{order}100d", *range(100)))
    heads, size = [element(14, inner)], len(inner) + 8
    for _ in range(levels):
        about = array(1, 1)
        heads.append(struct.pack(f"{order}II", 14, len(about) + size) + about)
        size += len(about) + 8
    variable = b"".join(reversed(heads))
    if packed:
        small = zlib.compress(variable)
        variable = struct.pack(f"{order}II", 15, len(small)) + small
    mark = struct.pack(f"{order}HH", 0x0100, 0x4D49)
    (tmp_path / "a.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + mark + variable)
    said = "its columns: ab" if levels == 100 else "arrays lie more than 500 deep in each other"
    assert refused(tmp_path / "a.mat").endswith(said)


@pytest.mark.parametrize("branches", [1, 40])
def test_groups_thousands_of_levels_inside_each_other_are_refused(tmp_path: Path, branches: int) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        for branch in range(branches):
            group = file.create_group(f"b{branch}")
            for _ in range(3000 // branches):
                group = group.create_group("g")
            group["x"] = np.arange(100.0)
    begun = time.process_time()
    assert refused(tmp_path / "a.h5").endswith("holds groups more than 64 deep inside each other")
    assert time.process_time() - begun < 1.0


@pytest.mark.parametrize("kind", ["external", "virtual", "itself"])
def test_a_table_whose_values_lie_in_another_file_of_this_machine_is_refused(tmp_path: Path, kind: str) -> None:
    h5py = pytest.importorskip("h5py")
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["x"] = np.arange(1000.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["right"] = np.arange(1000) / 100, np.arange(1000)
        if kind == "external":
            file.create_dataset("left", (1000,), "f8", external=[(secret, 0, 8000)])
        else:
            file["link"] = h5py.ExternalLink(secret, "x")  # by which a view of the file itself leads out of it
            view = h5py.VirtualLayout((1000,), "f8")
            view[:] = h5py.VirtualSource(*((secret, "x") if kind == "virtual" else (".", "link")), (1000,))
            file.create_virtual_dataset("left", view)
    assert "left takes its values from elsewhere" in refused(tmp_path / "a.h5")


@pytest.mark.parametrize("rows", [400_000, 1000])
def test_chunks_too_large_to_be_unpacked_are_refused(
    tmp_path: Path, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounds, "LARGEST", MEGABYTE)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("time", "left", "right"):
            made = file.create_dataset(name, (1000,), "f8", chunks=(rows,), maxshape=(None,), compression="gzip")
            made[:] = np.arange(1000)
    if rows == 1000:
        assert list(open_recording(tmp_path / "a.h5", TABLE).blocks())
    else:
        assert "pieces of 3 MB" in refused(tmp_path / "a.h5")


def test_a_matlab_file_that_unpacks_to_much_is_refused_unread(
    tmp_path: Path, small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = zlib.compress(bytes(20 * MEGABYTE), 9)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "a.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    monkeypatch.setattr("sprung.replay.series.loadmat", lambda *_, **__: pytest.fail("read"))
    assert "unpacks to more than" in refused(tmp_path / "a.mat")


@pytest.mark.parametrize("kind", ["parquet", "hdf5", "tdms", "mat"])
def test_more_values_than_a_file_can_hold_are_refused_from_what_it_states(
    tmp_path: Path, small: None, kind: str
) -> None:
    pytest.importorskip({"parquet": "pyarrow", "hdf5": "h5py", "tdms": "nptdms", "mat": "scipy"}[kind])
    name, write = SEEDS[kind]
    write(tmp_path / name)
    assert "states 600 values" in refused(tmp_path / name)


def test_row_groups_that_state_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow.parquet import write_table

    monkeypatch.setattr(bounds, "WHOLE_ALWAYS", 0)
    zeros = np.zeros(1_000_000)
    table = pyarrow.table({"time": zeros, "left": zeros, "right": zeros})
    write_table(table, tmp_path / "a.parquet", compression="zstd", use_dictionary=False)
    assert "unpacks to more than 22 MB" in refused(tmp_path / "a.parquet")


@pytest.mark.parametrize("lies", [False, True])
def test_an_mdf_file_whose_blocks_unpack_to_much_is_refused_unread(tmp_path: Path, small: None, lies: bool) -> None:
    name, write = SEEDS["mf4"]
    write(tmp_path / name)
    packed = zlib.compress(bytes(20 * MEGABYTE), 9)
    size = 100 if lies else 20 * MEGABYTE
    block = bounds.MDF_ZIPPED.pack(b"##DZ", bounds.MDF_ZIPPED.size + len(packed), 0, b"DT", 0, 0, size, len(packed))
    with (tmp_path / name).open("ab") as file:
        file.write(block + packed)
    assert "unpacks to more than" in refused(tmp_path / name)


def test_an_mdf_group_that_states_records_without_end_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    name, write = SEEDS["mf4"]
    write(tmp_path / name)
    data = bytearray((tmp_path / name).read_bytes())
    groups = [at for at in range(len(data)) if data[at : at + 4] == b"##CG"]
    for at in groups:
        data[at + 80 : at + 88] = (1 << 45).to_bytes(8, "little")  # after id, length, number of links, six of them, id
    (tmp_path / name).write_bytes(data)
    assert groups and "unpacks to more than" in refused(tmp_path / name)


def test_mdf_blocks_that_lead_in_a_circle_are_refused(tmp_path: Path) -> None:
    """Next of the header, of the history, of groups and of channels: asammdf followed each of them for ever."""
    pytest.importorskip("asammdf")
    name, write = SEEDS["mf4"]
    write(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    blocks = [found.start() for found in re.finditer(rb"##(HD|FH|DG|CG|CN)\0{4}", whole)]
    kinds = {whole[at : at + 4] for at in blocks}
    assert kinds == {b"##HD", b"##FH", b"##DG", b"##CG", b"##CN"}
    for kind in sorted(kinds):
        own = [at for at in blocks if whole[at : at + 4] == kind]
        for at, target in ((own[0], own[0]), (own[-1], own[0])):
            data = bytearray(whole)
            data[at + 24 : at + 32] = target.to_bytes(8, "little")
            (tmp_path / name).write_bytes(data)
            assert "so that reading would not end" in refused(tmp_path / name), kind


def test_an_mdf_file_of_an_older_version_is_refused_with_the_reason(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    (tmp_path / "a.mf4").write_bytes(b"MDF     3.30    ".ljust(64, b"\0") + b"HD".ljust(400, b"\0"))
    assert "of version 3.30; bus logs are read from version 4 on" in refused(tmp_path / "a.mf4")
