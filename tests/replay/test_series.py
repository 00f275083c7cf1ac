"""The same record as Parquet, MATLAB, HDF5, JSON, UFF, TDMS and NumPy, by libraries that others use; LabVIEW text."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from sprung.model.signals import Channel, FloatArray, TimeColumn
from sprung.replay import UnreadableRecording, open_recording, series
from sprung.replay.extras import needed
from sprung.replay.listing import signals_of
from sprung.replay.record import load_record
from tests.replay.test_tables import SECONDS, START, VALUES, F, X, check, read
from tests.replay_files import uff58

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
nptdms = pytest.importorskip("nptdms")
import pyarrow.parquet as pq  # noqa: E402

COLUMNS = {"time": SECONDS, "x": VALUES[:, 0], "F": VALUES[:, 1]}


def write_mat(path: Path) -> None:
    scipy.io.savemat(path, {**COLUMNS, "rate": 100.0, "title": "damper"})


def write_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file[name] = values


def write_mat73(path: Path) -> None:
    """MATLAB writes version 7.3 as HDF5 behind a header of 512 bytes, its vectors as rows of one column."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file[name] = values[None, :]
        file["#refs#/a"] = np.arange(7.0)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def write_parquet(path: Path) -> None:
    pq.write_table(pa.table(COLUMNS), path, row_group_size=128)


def write_json(path: Path) -> None:
    path.write_text(json.dumps({name: values.tolist() for name, values in COLUMNS.items()}))


def test_a_number_beyond_all_floats_costs_itself(tmp_path: Path) -> None:
    text = json.dumps({name: values.tolist() for name, values in COLUMNS.items()})
    first = json.dumps(VALUES[0, 0])
    (tmp_path / "a.json").write_text(text.replace(f'"x": [{first}', f'"x": [{"9" * 400}', 1))
    x, f = Channel("x", "m", 1.0, column="x"), Channel("F", "N", 1.0, column="F")
    _, values, _ = read(tmp_path / "a.json", (x, f))
    assert np.isnan(values[0, 0])
    np.testing.assert_array_equal(values[1:, 0], VALUES[1:, 0])


def test_a_series_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"time": [0.0, 0.01], "x": [1.0, 2.0], "x": [9.0, 9.0]}')
    with pytest.raises(UnreadableRecording, match="'x' is there twice"):
        read(tmp_path / "a.json", (Channel("x", "m", 1.0, column="x"),))


def write_npz(path: Path) -> None:
    np.savez_compressed(path, time=COLUMNS["time"], x=COLUMNS["x"], F=COLUMNS["F"])


WRITERS = {
    "a.npz": write_npz,
    "a.parquet": write_parquet,
    "a.mat": write_mat,
    "b.mat": write_mat73,
    "a.h5": write_hdf5,
    "a.hdf5": write_hdf5,
    "a.json": write_json,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_of_series_gives_the_same_samples(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name)
    assert check(tmp_path / name).relative
    record = load_record(tmp_path / name, (X, F), 100.0)
    assert np.array_equal(record.values, VALUES)


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_names_a_misspelt_column_and_refuses_what_it_is_not(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name)
    with pytest.raises(UnreadableRecording, match=r"columns not found: 'Fx'.*(its columns|did you mean)") as error:
        read(tmp_path / name, (Channel("F", "N", 1.0, column="Fx"),))
    assert "\n" not in str(error.value)
    for damage in (b"", b"no such format" * 40, (tmp_path / name).read_bytes()[:700]):
        (tmp_path / name).write_bytes(damage)
        with pytest.raises(UnreadableRecording) as error:
            read(tmp_path / name)
        assert str(error.value).startswith(str(tmp_path / name))
        assert "\n" not in str(error.value).strip()


def test_numpy_tables_and_matrices(tmp_path: Path) -> None:
    table = np.zeros(len(SECONDS), dtype=[("time", "f8"), ("x", "f4"), ("F", "f8")])
    for name, values in COLUMNS.items():
        table[name] = values
    np.save(tmp_path / "table.npy", table)
    x, f = (Channel(name, unit, 1.0, column=f"data.{name}") for name, unit in (("x", "m"), ("F", "N")))
    _, values, _ = read(tmp_path / "table.npy", (x, f))
    assert np.allclose(values, VALUES, atol=1e-7)
    np.save(tmp_path / "matrix.npy", VALUES)
    x, f = (Channel(name, "N", 1.0, column=f"data(:,{i})") for i, name in enumerate("xF", 1))
    _, values, _ = read(tmp_path / "matrix.npy", (x, f), time=TimeColumn(rate=100.0))
    np.testing.assert_array_equal(values, VALUES)


def test_a_pickle_in_a_numpy_file_is_not_run(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(UnreadableRecording, match="not a NumPy file that can be read"):
        read(tmp_path / "a.npy")


def _lvm(kind: str, point: str) -> str:
    """As LabVIEW writes it: a header, a segment's header, rows, each ended by a comment's empty cell."""
    head = [
        *("LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"),
        *(f"Decimal_Separator\t{point}", "Multi_Headings\tNo", f"X_Columns\t{kind}", "Time_Pref\tRelative"),
        *("***End_of_Header***\t", "\t", "Channels\t2\t\t", "Samples\t500\t500\t"),
        *("Date\t2026/03/01\t2026/03/01\t", f"Time\t12:00:00{point}25\t12:00:00{point}25\t"),
        *("Y_Unit_Label\tm\tN\t", f"X0\t0{point}0E+0\t0{point}0E+0\t", f"Delta_X\t0{point}01\t0{point}01\t"),
        "***End_of_Header***\t\t\t",
    ]
    title = {"One": "X_Value\tx\tF", "Multi": "X_Value\tx\tX_Value\tF", "No": "X_Value\tx\tF"}[kind]
    rows = []
    for t, (x, f) in zip(SECONDS, VALUES, strict=True):
        cells = {"One": (t, x, f), "Multi": (t, x, t, f), "No": ("", x, f)}[kind]
        rows.append("\t".join(str(cell) for cell in cells).replace(".", point) + "\t")
    return "\r\n".join([*head, title + "\tComment", *rows, ""])


@pytest.mark.parametrize("kind", ["One", "Multi", "No"])
@pytest.mark.parametrize("point", [".", ","])
def test_labview_text_has_names_units_and_times(tmp_path: Path, kind: str, point: str) -> None:
    (tmp_path / "a.lvm").write_text(_lvm(kind, point), newline="")
    times, values, account = read(tmp_path / "a.lvm")
    np.testing.assert_array_equal(values, VALUES)
    assert datetime.fromtimestamp(times[0] / 1e9, UTC) == datetime(2026, 3, 1, 12, 0, 0, 250_000, tzinfo=UTC)
    assert times[-1] - times[0] == 4_990_000_000 and not account.relative


@pytest.mark.parametrize(
    "damage", ["", "time,x\n1,2\n", _lvm("One", ".")[:300], _lvm("One", ".").replace("0.01", "often")]
)
def test_damaged_labview_text_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    (tmp_path / "a.lvm").write_text(damage)
    with pytest.raises(UnreadableRecording) as error:
        read(tmp_path / "a.lvm")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("time", [TimeColumn("when"), TimeColumn()])
def test_parquet_with_real_time_stamps_and_units(tmp_path: Path, time: TimeColumn) -> None:
    stamps = (START + 10_000_000 * np.arange(500)).astype("datetime64[ns]")
    fields = [
        pa.field("when", pa.timestamp("ns")),
        pa.field("x", pa.float32(), metadata={"unit": "mm"}),
        pa.field("F", pa.float64()),
    ]
    table = pa.table([pa.array(stamps), pa.array(VALUES[:, 0], pa.float32()), VALUES[:, 1]], schema=pa.schema(fields))
    pq.write_table(table, tmp_path / "a.parquet")
    times, values, account = read(tmp_path / "a.parquet", time=time)
    assert [channel.column for channel, _ in signals_of(tmp_path / "a.parquet").signals] == ["x", "F"]
    assert (times[0], times[-1]) == (START, START + 4_990_000_000)
    assert np.allclose(values, VALUES, atol=1e-7)
    assert not account.relative


def test_structures_and_matrices_of_matlab_have_names_as_in_matlab(tmp_path: Path) -> None:
    rig = {"t": SECONDS, "signals": {"values": VALUES}}
    scipy.io.savemat(tmp_path / "a.mat", {"rig": rig, "label": np.array(["a", "b"]), "empty": np.zeros((0, 3))})
    x = Channel("x", "m", 1.0, column="rig.signals.values(:,1)")
    f = Channel("F", "N", 1.0, column="rig.signals.values(:,2)")
    check(tmp_path / "a.mat", (x, f))
    check(tmp_path / "a.mat", (x, f), TimeColumn("rig.t"))


def _mat73_sheets(path: Path, sheets: FloatArray) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file["runs"] = sheets.transpose()  # axes backwards, as MATLAB writes them
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


SHEETS_OF: dict[str, Callable[[Path, FloatArray], object]] = {
    "a.mat": lambda path, sheets: scipy.io.savemat(path, {"runs": sheets}),
    "b.mat": _mat73_sheets,
    "a.npz": lambda path, sheets: np.savez(path, runs=sheets),
    "a.json": lambda path, sheets: path.write_text(json.dumps({"runs": sheets.tolist()})),
}


@pytest.mark.parametrize("name", SHEETS_OF)
def test_series_of_arrays_with_three_axes_are_addressed_by_column_and_sheet(tmp_path: Path, name: str) -> None:
    sheets = np.stack([VALUES, 2 * VALUES, 3 * VALUES], axis=2)  # (500, 2, 3)
    SHEETS_OF[name](tmp_path / name, sheets)
    for sheet in (1, 3):
        x, f = (Channel(c, "N", 1.0, column=f"runs(:,{i},{sheet})") for i, c in enumerate("xF", 1))
        _, values, _ = read(tmp_path / name, (x, f), time=TimeColumn(rate=100.0))
        np.testing.assert_array_equal(values, sheet * VALUES)
    listing = signals_of(tmp_path / name)
    assert [channel.column for channel, _ in listing.signals] == ["runs(:,1,1)", "runs(:,2,1)"]
    assert "4 more series of further sheets are addressed alike: runs(:,1,2) to runs(:,2,3)" in listing.notes


def test_json_rows_and_matrices(tmp_path: Path) -> None:
    rows = [
        {"time": t, "x": x, "F": f, "note": "n"} for t, (x, f) in zip(SECONDS.tolist(), VALUES.tolist(), strict=True)
    ]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    check(tmp_path / "a.json")
    (tmp_path / "b.json").write_text(json.dumps({"data": np.c_[SECONDS, VALUES].tolist(), "rate": 100}))
    numbered = (Channel("x", "m", 1.0, column="data(:,2)"), Channel("F", "N", 1.0, column="data(:,3)"))
    check(tmp_path / "b.json", numbered, TimeColumn("data(:,1)"))


def test_nodes_of_different_rates_have_times_of_their_own_and_come_in_time_order(tmp_path: Path) -> None:
    fast, slow = np.arange(4000) / 400.0, np.arange(1000) / 100.0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["node1/time"], file["node1/acc"] = fast, np.sin(fast)
        file["node2/time"], file["node2/acc"] = slow, np.cos(slow)
    one, two = (Channel(f"n{i}", "m/s^2", 0.01, column=f"node{i}/acc") for i in (1, 2))
    blocks = list(open_recording(tmp_path / "a.h5", (one, two)).blocks())
    times = np.concatenate([block.time for block in blocks])
    assert (np.diff(times) >= 0).all()
    record = load_record(tmp_path / "a.h5", (one, two), 100.0)
    grid = record.start / 1e9 + np.arange(len(record.values)) / 100.0
    assert np.allclose(record.values, np.stack([np.sin(grid), np.cos(grid)], axis=1), atol=1e-4)
    assert len(grid) > 940
    with pytest.raises(UnreadableRecording, match=r"node1/acc has 4000 values, its time node2/time has 1000"):
        load_record(tmp_path / "a.h5", (one,), 100.0, time=TimeColumn("node2/time"))


def test_tdms_waveforms_have_their_own_clock(tmp_path: Path) -> None:
    def channel(name: str, values: FloatArray, **extra: object) -> Any:
        start = np.datetime64(datetime.fromtimestamp(START / 1e9, UTC).replace(tzinfo=None), "us")
        said = {"wf_start_time": start, "wf_increment": 0.01, "wf_start_offset": 0.0, "unit_string": "N", **extra}
        return nptdms.ChannelObject("Messung", name, values, properties=said)

    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        for part in np.array_split(np.arange(500), 3):  # segments
            writer.write_segment([channel("x", VALUES[part, 0]), channel("F", VALUES[part, 1])])
    x, f = Channel("x", "m", 1.0, column="Messung/x"), Channel("F", "N", 1.0, column="Messung/F")
    assert not check(tmp_path / "a.tdms", (x, f), start=START).relative
    with series.opened(tmp_path / "a.tdms") as columns:
        assert [(c.name, c.unit, c.length) for c in columns] == [("Messung/x", "N", 500), ("Messung/F", "N", 500)]
    with nptdms.TdmsWriter(tmp_path / "b.tdms") as writer:
        objects = [nptdms.ChannelObject("g", name, values) for name, values in COLUMNS.items()]
        writer.write_segment(objects)
    check(tmp_path / "b.tdms", (Channel("x", "m", 1.0, column="g/x"), Channel("F", "N", 1.0, column="g/F")))


UNITS_DATASET = b"    -1\n   164\n         1SI: m N s            2\n  1.0  1.0  1.0\n    -1\n"


@pytest.mark.parametrize("binary", [None, "<", ">"])
@pytest.mark.parametrize("kind", [2, 4])
def test_universal_files_in_text_and_binary(tmp_path: Path, binary: str | None, kind: int) -> None:
    data = UNITS_DATASET
    data += uff58(12, 3, VALUES[:, 0], kind=kind, binary=binary) + uff58(7, -1, VALUES[:, 1], kind=kind, binary=binary)
    (tmp_path / "a.uff").write_bytes(data)
    x, f = Channel("x", "m", 1.0, column="12+Z"), Channel("F", "N", 1.0, column="7-X")
    times, values, _ = read(tmp_path / "a.uff", (x, f))
    assert np.array_equal(times, np.rint(SECONDS * 1e9).astype(np.int64))
    assert np.allclose(values, VALUES, rtol=1e-5 if kind == 2 else 1e-11, atol=1e-9)
    with series.opened(tmp_path / "a.uff") as columns:
        assert [(c.name, c.unit) for c in columns] == [("12+Z", "N"), ("7-X", "N")]


def test_universal_files_with_uneven_times_dates_and_other_functions(tmp_path: Path) -> None:
    times = SECONDS + np.where(np.arange(500) % 2, 0.002, 0.0)
    frf = uff58(3, 3, np.zeros(8), kind=4).replace(f"{1:5d}{0:10d}{0:5d}".encode(), f"{4:5d}{0:10d}{0:5d}".encode(), 1)
    data = frf + uff58(12, 3, VALUES[:, 0], even=False, times=times)
    (tmp_path / "a.unv").write_bytes(data.replace(b"\n", b"\r\n"))
    blocks = list(open_recording(tmp_path / "a.unv", (Channel("x", "m", 1.0, column="12+Z/value"),)).blocks())
    assert np.allclose(blocks[0].time / 1e9, times, atol=1e-5)
    assert np.allclose(blocks[0].value, VALUES[:, 0], atol=1e-9)
    (tmp_path / "b.uff").write_bytes(uff58(0, 0, VALUES[:, 0], date="21-SEP-26 14:13:20"))
    x = Channel("x", "m", 1.0, column="Signal of a test")
    assert read(tmp_path / "b.uff", (x,))[0][0] == START
    (tmp_path / "c.uff").write_bytes(frf)
    with pytest.raises(UnreadableRecording, match="no time responses"):
        read(tmp_path / "c.uff", (x,))
    (tmp_path / "d.uff").write_bytes(uff58(12, 3, VALUES[:, 0]).replace(b"\n         4", b"\n         x"))
    with pytest.raises(UnreadableRecording, match="a damaged dataset 58"):
        read(tmp_path / "d.uff", (x,))


def test_a_missing_library_is_named_with_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(
        UnreadableRecording, match=r"a.h5: reading .h5 files needs no_such; pip install 'sprung\[hdf5\]'"
    ):
        needed("no_such", "hdf5", tmp_path / "a.h5")
