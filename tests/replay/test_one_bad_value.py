"""One value, time or count that is none costs itself, is reported, and leaves the rest as it is."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.signals import Channel
from sprung.replay import UnreadableRecording
from sprung.replay.listing import signals_of
from tests.fuzz.seeds import TABLE, UNIVERSAL
from tests.replay_files import LEFT, NUMBERS, RIGHT, read, uff58

EPOCH = 1_790_000_000
ROWS, BAD = 200, 120
SECONDS = NUMBERS / 100


def table(times: list[str], left: list[str]) -> str:
    rows = [f"{t},{x},{i % 5}" for i, (t, x) in enumerate(zip(times, left, strict=True))]
    return "\n".join(["time,left,right", *rows]) + "\n"


def objects(times: list[str], left: list[str]) -> str:
    right = json.dumps([i % 5 for i in range(ROWS)])
    return f'{{"time": [{", ".join(times)}], "left": [{", ".join(left)}], "right": {right}}}'


def by_row(times: list[str], left: list[str]) -> str:
    rows = (f'{{"time": {t}, "left": {x}, "right": {i % 5}}}' for i, (t, x) in enumerate(zip(times, left, strict=True)))
    return f"[{', '.join(rows)}]"


@pytest.mark.parametrize("at", [0, BAD])
@pytest.mark.parametrize("scale", [1, 1000])
@pytest.mark.parametrize("bad", ["0", "1e300", "-5e9", "9e18"])
@pytest.mark.parametrize(("name", "make"), [("a.csv", table), ("a.json", objects)])
def test_a_time_that_is_none_costs_its_row(
    name: str, make: Callable[[list[str], list[str]], str], bad: str, scale: int, at: int, tmp_path: Path
) -> None:
    """Also the first one, by which unit and epoch are recognised."""
    times = [f"{scale * (EPOCH + i / 100):.3f}" for i in range(ROWS)]
    times[at] = bad
    (tmp_path / name).write_text(make(times, [str(i % 7) for i in range(ROWS)]))
    _, samples = read(tmp_path / name, channels=TABLE)
    stamps, values = samples[0]
    kept = np.abs(stamps / 1e9 - EPOCH) < 10
    expected = [i for i in range(ROWS) if i != at]
    assert stamps[kept] == pytest.approx([(EPOCH + i / 100) * 1e9 for i in expected], abs=1000)
    assert values[kept].tolist() == [i % 7 for i in expected]


@pytest.mark.parametrize("at", [0, BAD])
@pytest.mark.parametrize(
    "bad", ["0001-01-01T00:00:00", "9999-12-31T23:59:59", "1600-01-01 00:00:00", "2262-12-31 00:00"]
)
def test_a_date_that_no_clock_shows_costs_its_row(bad: str, at: int, tmp_path: Path) -> None:
    """0001 and 9999 are what databases and .NET write where there is none."""
    times = [f"2026-01-01T00:00:{i / 100:05.2f}" for i in range(ROWS)]
    times[at] = bad
    (tmp_path / "a.csv").write_text(table(times, ["1"] * ROWS))
    recording, samples = read(tmp_path / "a.csv", channels=TABLE)
    assert len(samples[0][0]) == ROWS - 1
    assert recording.incomplete and recording.tally.corrupt == 1


@pytest.mark.parametrize(
    ("bad", "reported"), [('"x"', True), ("[1]", True), ("{}", True), ("null", False), ('"N/A"', False)]
)
@pytest.mark.parametrize("make", [objects, by_row])
def test_a_value_in_json_that_is_no_number_costs_itself(
    make: Callable[[list[str], list[str]], str], bad: str, reported: bool, tmp_path: Path
) -> None:
    left = [str(i % 7) for i in range(ROWS)]
    left[BAD] = bad
    (tmp_path / "a.json").write_text(make([str(i / 100) for i in range(ROWS)], left))
    recording, samples = read(tmp_path / "a.json", channels=TABLE)
    values = dict(zip(np.rint(samples[0][0] / 1e7).astype(int).tolist(), samples[0][1].tolist(), strict=True))
    assert np.isnan(values.pop(BAD, np.nan))
    assert values == {i: i % 7 for i in range(ROWS) if i != BAD}
    assert len(samples[1][0]) == ROWS  # the others
    told = [line for line in recording.problems if "are no numbers" in line]
    assert len(told) == reported and recording.incomplete == reported


def damaged(record: int, first: int, text: str) -> bytes:
    """A universal file in whose first dataset a field of a record is another one."""
    one = uff58(12, 3, LEFT, times=SECONDS)
    lines = one.split(b"\n")
    lines[record] = lines[record][:first] + text.encode() + lines[record][first + len(text) :]
    return b"\n".join(lines) + uff58(7, -1, RIGHT, times=SECONDS)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (damaged(8, 10, f"{10**9:10d}"), "999999700 of its values are not there"),
        (uff58(7, -1, RIGHT, times=SECONDS) + uff58(12, 3, LEFT, times=SECONDS, binary="<")[:-900], "are not there"),
        (uff58(7, -1, RIGHT, times=SECONDS) + uff58(12, 3, LEFT, times=SECONDS)[:-907], "are not there"),
        (damaged(20, 3, "?"), "1 of its values are not there"),
    ],
)
def test_universal_files_that_hold_less_than_they_state_are_incomplete(
    content: bytes, told: str, tmp_path: Path
) -> None:
    (tmp_path / "a.uff").write_bytes(content)
    recording, samples = read(tmp_path / "a.uff", channels=UNIVERSAL)
    assert recording.incomplete and any(told in line for line in recording.problems)
    assert len(samples[1][0]) == len(RIGHT) and len(samples[0][0]) > 100


@pytest.mark.parametrize("content", [damaged(7, 0, "    x"), damaged(8, 0, f"{'x':>10}"), damaged(9, 0, f"{'x':>10}")])
def test_a_damaged_dataset_of_a_universal_file_costs_itself(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.uff").write_bytes(content)
    recording, samples = read(tmp_path / "a.uff", channels=UNIVERSAL)
    assert recording.incomplete and len(samples[1][0]) == len(RIGHT)


@pytest.mark.parametrize("packing", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_damaged_array_of_numpy_costs_itself(packing: int, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", packing) as file:
        for name, values in {"time": SECONDS, "left": LEFT, "right": RIGHT}.items():
            whole = io.BytesIO()
            np.save(whole, values)
            file.writestr(f"{name}.npy", whole.getvalue())
        at = file.getinfo("left.npy").header_offset + 300
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[at : at + 40] = bytes(40)
    (tmp_path / "a.npz").write_bytes(content)
    recording, samples = read(tmp_path / "a.npz", channels=TABLE)
    assert recording.incomplete and any("left cannot be read" in line for line in recording.problems)
    assert np.array_equal(samples[1][1], RIGHT) and not len(samples[0][0])
    assert any("left out, since it cannot be read: left" in note for note in signals_of(tmp_path / "a.npz").notes)


@pytest.mark.parametrize("size", [-1, -600, -870, -900, -1200])
def test_negative_sizes_do_not_lead_back(size: int, tmp_path: Path) -> None:
    whole = uff58(12, 3, LEFT, times=SECONDS, binary="<")
    head = whole.split(b"\n")[1]
    (tmp_path / "a.uff").write_bytes(whole.replace(head, head[:31] + f"{size:12d}".encode() + head[43:], 1))
    with pytest.raises(UnreadableRecording, match=f"it states {size} bytes"):
        read(tmp_path / "a.uff", channels=UNIVERSAL)


@pytest.mark.parametrize(
    "said",
    [
        {"wf_increment": "abc"},
        {"wf_increment": np.inf},
        {"wf_increment": 0.01, "wf_start_offset": 1e300},
        {"unit_string": 5},
    ],
)
def test_properties_of_tdms_that_are_none_are_passed_over(said: dict[str, Any], tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    columns = {"time": SECONDS, "left": LEFT, "right": RIGHT}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("group", n, v, properties=said) for n, v in columns.items()])
    channels = [Channel(c.name, c.unit, c.noise, column=f"group/{c.csv}") for c in TABLE]
    _, samples = read(tmp_path / "a.tdms", channels=channels)
    assert samples[0][1].tolist() == LEFT.tolist()


def test_complex_numbers_of_tdms_are_no_samples(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    columns = {"time": SECONDS, "left": LEFT + 1j, "right": RIGHT}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("group", name, values) for name, values in columns.items()])
    channels = [Channel(c.name, c.unit, c.noise, column=f"group/{c.csv}") for c in TABLE]
    recording, samples = read(tmp_path / "a.tdms", channels=channels)
    assert np.isnan(samples[0][1]).all()  # what is real of them would be taken for it
    assert "group/left: 300 of its values are no numbers, and taken as missing" in recording.problems
    assert samples[1][1].tolist() == RIGHT.tolist()


LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{x}\n***End_of_Header***\t\nChannels\t2\n{clock}"
    "***End_of_Header***\t\nX_Value\tleft\tright\n"
)


@pytest.mark.parametrize("clock", ["", "Delta_X\t0.01\t0.01\nX0\t0\t0\n"])
@pytest.mark.parametrize(("bad", "reported"), [("", False), ("x", True), ("inf", True)])
def test_a_cell_of_labview_that_is_no_number_costs_itself(clock: str, bad: str, reported: bool, tmp_path: Path) -> None:
    """What comes after it keeps its time."""
    rows = [f"{i / 100}\t{i % 7}\t{i % 5}" for i in range(ROWS)]
    rows[0], rows[BAD], rows[-1] = f"0\t{bad}\t0", f"{BAD / 100}\t{bad}\t0", f"{(ROWS - 1) / 100}\t\t4"
    (tmp_path / "a.lvm").write_text(LVM.format(x="One", clock=clock) + "\n".join(rows) + "\n")
    recording, samples = read(tmp_path / "a.lvm", channels=TABLE)
    times, values = samples[0]
    known = ~np.isnan(values)
    assert times[known].tolist() == [i * 10**7 for i in range(ROWS) if i not in (0, BAD, ROWS - 1)]
    assert values[known].tolist() == [i % 7 for i in range(ROWS) if i not in (0, BAD, ROWS - 1)]
    assert recording.incomplete == reported


def test_notes_beside_arrays_cost_only_themselves(tmp_path: Path) -> None:
    """Pickled objects are never read, and neither stops others from being."""
    np.savez(tmp_path / "a.npz", time=SECONDS, left=LEFT, right=RIGHT, about=np.array({"by": "us"}, dtype=object))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as packed:
        packed.writestr("readme.txt", "hello")
    _, samples = read(tmp_path / "a.npz", channels=TABLE)
    assert samples[0][1].tolist() == LEFT.tolist()


def test_an_empty_dataset_costs_only_itself(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in {"time": SECONDS, "left": LEFT, "right": RIGHT}.items():
            file[name] = values
        file["nothing"] = h5py.Empty("f8")
    _, samples = read(tmp_path / "a.h5", channels=TABLE)
    assert samples[0][1].tolist() == LEFT.tolist()
