"""Own data without a conversion script: text tables of every kind, and the times in them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.signals import ANY_TIME, Channel, FloatArray, IntArray, TimeColumn
from sprung.replay import UnreadableRecording, open_recording
from sprung.replay.account import Account
from sprung.replay.csvlayout import is_unit, unit_in
from sprung.replay.record import load_record
from sprung.replay.stamps import Stamps

X = Channel("x", "m", 1e-6, column="x")
F = Channel("F", "N", 1.0, column="F")
SECONDS = np.arange(500) / 100.0
VALUES = np.stack([np.sin(3 * SECONDS).round(6), (100 * np.cos(3 * SECONDS)).round(4)], axis=1)
START = 1_790_000_000_000_000_000  # 2026-09-21T14:13:20Z


def table(
    separator: str = ",",
    comma: bool = False,
    times: Iterable[str | float] = SECONDS,
    before: str = "time,x,F\n",
    end: str = "\n",
) -> str:
    rows = [
        [t if isinstance(t, str) else f"{t:.9g}", f"{x:.6f}", f"{f:.4f}"]
        for t, (x, f) in zip(times, VALUES, strict=True)
    ]
    if comma:
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    return before + "".join(separator.join(row) + end for row in rows)


def read(
    path: Path, channels: Sequence[Channel] = (X, F), time: TimeColumn = ANY_TIME, **options: Any
) -> tuple[IntArray, FloatArray, Account]:
    """Times (n,) and values (n, 2) of every row, and the account."""
    recording = open_recording(path, channels, time=time, **options)
    blocks = list(recording.blocks())
    times = np.concatenate([b.time for b in blocks])[:: len(channels)]
    values = np.concatenate([b.value for b in blocks]).reshape(-1, len(channels))
    return times, values, recording.account


def check(
    path: Path, channels: Sequence[Channel] = (X, F), time: TimeColumn = ANY_TIME, start: int = 0, **options: Any
) -> Account:
    times, values, account = read(path, channels, time, **options)
    assert np.array_equal(times, start + np.rint(SECONDS * 1e9).astype(np.int64))
    assert np.array_equal(values, VALUES)
    assert account.tally.used == len(VALUES)
    assert not account.incomplete
    return account


TEXTS = {
    "comma": table(),
    "semicolon": table(";", before="time;x;F\n"),
    "semicolon and decimal comma": table(";", comma=True, before="time;x;F\n"),
    "tab": table("\t", before="time\tx\tF\n"),
    "tab and decimal comma": table("\t", comma=True, before="time\tx\tF\n"),
    "blanks": table("  ", before="  time   x  F\n"),
    "quoted decimal comma": '"time","x","F"\n'
    + "".join('"' + row.replace(".", ",").replace(";", '","') + '"\n' for row in table(";", before="").splitlines()),
    "bar": table("|", before="time|x|F\n"),
    "CRLF": table(end="\r\n"),
    "comment lines": "# rig 7\n# 100 Hz\n" + table() + "# end of test\n",
    "commented header": "# test of a damper\n# time, x, F\n" + table(before=""),
    "units row": table(before="time,x,F\ns,m,N\n"),
    "units row in brackets": table(before="time,x,F\n[s],[m],[N]\n"),
    "units and an empty row": table("\t", before="time\tx\tF\nSec\tm\tN\n\t\t\n\n"),
    "preamble": "Damper test, Mon 3 May\nOperator,N. N.\nSampling Frequency - 100\n\n" + table(),
    "byte order mark": "\ufeff" + table(),
    "other names of time": table(before="Timestamp,x,F\n"),
    "time with its unit": table(before="Time [s],x,F\n"),
    "time in ms by its header": table(times=SECONDS * 1000, before="Time (ms),x,F\n"),
    "time in us by its name": table(times=SECONDS * 1e6, before="time_us,x,F\n"),
    "time in ms by its units row": table(times=SECONDS * 1000, before="t,x,F\nms,m,N\n"),
    "other order and further columns": "note;F;x;t\n"
    + "".join(f"a;{f:.4f};{x:.6f};{t:.9g}\n" for t, (x, f) in zip(SECONDS, VALUES, strict=True)),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_table_of_any_layout_is_read_exactly(tmp_path: Path, kind: str) -> None:
    for name in ("a.csv", "a.txt"):
        (tmp_path / name).write_text(TEXTS[kind], encoding="utf-8")
        assert check(tmp_path / name).relative


def test_encodings_that_spreadsheets_write(tmp_path: Path) -> None:
    text = table(before="time,Weg µm,Kraft\n")
    named = (Channel("x", "m", 1.0, column="Weg µm"), Channel("F", "N", 1.0, column="Kraft"))
    for encoding in ("utf-8", "utf-16", "cp1252"):
        (tmp_path / "a.csv").write_bytes(text.encode(encoding))
        check(tmp_path / "a.csv", named)


def test_a_table_without_header_is_addressed_by_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table(before=""))
    numbered = (Channel("x", "m", 1.0, column="2"), Channel("F", "N", 1.0, csv="3"))
    assert "no header: the columns are numbered 1 to 3" in check(tmp_path / "a.csv", numbered).problems
    check(tmp_path / "a.csv", numbered, TimeColumn("1"))


def test_a_first_column_that_does_not_rise_is_no_time(tmp_path: Path) -> None:
    """A table of signals alone: its rate has to be said."""
    rows = "\n".join(f"{np.sin(0.3 * i):.6f} {np.cos(0.3 * i):.6f}" for i in range(400))
    (tmp_path / "a.txt").write_text(rows)
    channels = [Channel("x", "m", 1.0, column="1")]
    with pytest.raises(UnreadableRecording, match="no column of times is recognised"):
        load_record(tmp_path / "a.txt", channels, 200.0)
    record = load_record(tmp_path / "a.txt", channels, 200.0, time=TimeColumn(rate=200.0))
    assert len(record.values) == 400


def test_two_columns_of_one_name_are_distinguished_by_number(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table(before="time,x,x\n"))
    with pytest.raises(
        UnreadableRecording, match=r"2 columns are called 'x'; select one by its number: `column: 2` or 3"
    ):
        read(tmp_path / "a.csv")
    check(tmp_path / "a.csv", (Channel("x", "m", 1.0, column="2"), Channel("F", "N", 1.0, column="3")))


def test_without_a_time_column_the_rate_must_be_said(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,F\n" + "".join(f"{x:.6f},{f:.4f}\n" for x, f in VALUES))
    with pytest.raises(
        UnreadableRecording, match=r"no column of times is recognised; set `time: \{column: NAME, unit: s"
    ):
        read(tmp_path / "a.csv")
    check(tmp_path / "a.csv", time=TimeColumn(rate=100.0))


@pytest.mark.parametrize(
    ("written", "start"),
    [
        (lambda i: f"2026-09-21T14:13:{20 + i // 100:02d}.{i % 100:02d}Z", START),
        (lambda i: f"2026-09-21 14:13:{20 + i // 100:02d}.{i % 100:02d}0", START),
        (lambda i: f"2026-09-21T16:13:{20 + i // 100:02d}.{i % 100:02d}0000+02:00", START),
        (lambda i: f"21.09.2026 14:13:{20 + i // 100:02d}.{i % 100:02d}", START),
        (lambda i: f"9/21/2026 2:13:{20 + i // 100:02d}.{i % 100:02d} PM", START),
        (lambda i: f"2026/09/21 14:13:{20 + i // 100:02d}.{i % 100:02d}", START),
        (lambda i: f"14:13:{20 + i // 100:02d}.{i % 100:02d}", (14 * 3600 + 13 * 60 + 20) * 10**9),
    ],
)
def test_written_times_are_read_to_the_nanosecond(tmp_path: Path, written: Callable[[int], str], start: int) -> None:
    (tmp_path / "a.csv").write_text(table(times=[written(i) for i in range(500)], before="Timestamp,x,F\n"))
    account = check(tmp_path / "a.csv", start=start)
    assert account.relative == (start < START)


@pytest.mark.parametrize(
    ("times", "time", "start"),
    [
        (SECONDS * 1000, TimeColumn("T", 1e-3), 0),
        (SECONDS / 3600, TimeColumn("T", 3600.0), 0),
        (SECONDS, TimeColumn("T", None, START), START),
        ([str(START // 10**9 * 1000 + 10 * i) for i in range(500)], TimeColumn("T"), START),
        ([str(START + 10_000_000 * i) for i in range(500)], TimeColumn("T"), START),
        ([f"{START // 10**9}.{i:03d}" for i in range(0, 1000, 10)] * 5, TimeColumn("T"), None),
    ],
)
def test_time_of_any_unit_and_epoch(
    tmp_path: Path, times: Iterable[str | float], time: TimeColumn, start: int | None
) -> None:
    (tmp_path / "a.csv").write_text(table(times=times, before="T,x,F\n"))
    if start is None:  # a float of Unix seconds is good for a quarter of a microsecond
        read_times, _, account = read(tmp_path / "a.csv", time=time)
        assert np.abs(np.diff(read_times[:100]) - 10_000_000).max() < 500
        assert not account.relative
        return
    times_read, _, account = read(tmp_path / "a.csv", time=time)
    assert np.abs(times_read - start - np.rint(SECONDS * 1e9)).max() <= (20 if start == 0 else 300)
    assert account.relative == (start == 0)


def test_days_of_matlab_are_read_without_losing_their_fraction() -> None:
    account = Account()
    days = 719529.0 + 20_000.0
    stamps = Stamps(TimeColumn("t", 86400.0, -719529 * 86400 * 10**9), None, account)
    ns, good = stamps.nanoseconds(np.array([days, np.nan, days + 0.5]))
    assert good.tolist() == [True, False, True]
    assert ns[[0, 2]].tolist() == [20_000 * 86400 * 10**9, 20_000 * 86400 * 10**9 + 43200 * 10**9]


def test_times_that_no_calendar_holds_are_refused_or_counted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,x,F\n1e300,1,2\n2e300,3,4\n")
    with pytest.raises(UnreadableRecording, match="lies beyond the year 2116"):
        read(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("time,x,F\n0,1,2\n1e300,3,4\n0.01,5,6\n")
    times, values, account = read(tmp_path / "a.csv")
    assert (times.tolist(), values[:, 0].tolist()) == ([0, 10_000_000], [1.0, 5.0])
    assert account.tally.corrupt == 1
    assert account.tally.reasons["row without a time"] == 1


def test_a_misspelt_column_is_named_with_its_neighbours(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table(before="time,x,force\n"))
    with pytest.raises(UnreadableRecording, match=r"'Force' \(did you mean 'force'\?\); its columns: time, x, force"):
        read(tmp_path / "a.csv", (X, Channel("F", "N", 1.0, csv="Force")))
    with pytest.raises(UnreadableRecording, match=r"no time column 'tme' \(did you mean 'time'\?\)"):
        read(tmp_path / "a.csv", (X,), TimeColumn("tme"))


def test_a_column_that_is_another_channels_is_no_misspelling(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,acc_front_left,b\n0,1,2\n0.01,3,4\n")
    left, right = (Channel(side, "m/s^2", 1.0, csv=f"acc_front_{side}") for side in ("left", "right"))
    read(tmp_path / "a.csv", (left,))
    blocks = open_recording(tmp_path / "a.csv", (left, right))
    assert sum(len(block.time) for block in blocks.blocks()) == 2
    assert "no column 'acc_front_right' for right" in blocks.problems


def test_damage_is_counted_row_by_row(tmp_path: Path) -> None:
    rows = [
        "time,x,F",
        "0,1,2",
        "0.01,1_0,2",
        "0.02,٣,2",
        "0.03,1",
        "",
        "0.04,,nan",
        '0.05,"3,4',
        "0.06,inf,5",
        "abc,1,2",
    ]
    (tmp_path / "a.csv").write_text("\n".join([*rows, *(f"{0.07 + i / 100:.2f},{i},{i}" for i in range(50))]) + "\n")
    _, values, account = read(tmp_path / "a.csv")
    assert values[:3, 0].tolist()[0] == 1.0
    assert np.isnan(values[1]).tolist() == [True, True]
    assert np.isnan(values[2]).tolist() == [True, False]
    assert account.tally.corrupt == 5
    assert account.tally.dropped == 1
    assert account.tally.used == 52


def test_a_line_without_end_is_one_corrupt_row_and_memory_stays_small(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table() + "5," * 1_500_000 + "\n" + "5.00,1,2\n")
    _times, values, account = read(tmp_path / "a.csv")
    assert len(values) == 501
    assert account.tally.reasons["line longer than a mebibyte"] == 1


def test_too_many_columns_and_binary_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(",".join(["time", *map(str, range(20_000))]) + "\n" + "1," * 20_000 + "1\n")
    with pytest.raises(UnreadableRecording, match=r"20001 columns; at most 10000"):
        read(tmp_path / "a.csv", (Channel("x", "m", 1.0, column="5"),))
    (tmp_path / "a.csv").write_bytes(bytes(range(256)) * 100 + b"\0" * 10_000)
    with pytest.raises(UnreadableRecording, match="binary data"):
        read(tmp_path / "a.csv")


def test_units_are_found_in_names() -> None:
    assert unit_in("Force [kN]") == ("Force", "kN")
    assert unit_in("Time (ms)") == ("Time", "ms")
    assert unit_in("Accel, g") == ("Accel", "g")
    assert unit_in("x_mm") == ("x", "mm")
    assert unit_in("Run (2)") == ("Run (2)", None)
    assert unit_in("front_left") == ("front_left", None)
    assert is_unit("m/s²")
    assert not is_unit("left")


def test_recorded_numbers_are_converted_when_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table())
    scaled = (Channel("x", "m", 1.0, column="x", gain=-0.001), Channel("F", "N", 1.0, column="F", gain=2.0, offset=5.0))
    _, values, _ = read(tmp_path / "a.csv", scaled)
    assert np.allclose(values, np.stack([-0.001 * VALUES[:, 0], 2 * VALUES[:, 1] + 5], axis=1), rtol=1e-15)


def test_a_ride_whose_times_begin_at_0_gets_a_start(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table(times=SECONDS + 7.0))
    times, _, account = read(tmp_path / "a.csv", start=START)
    assert times[0] == START
    assert account.relative
    assert account.problems == ["its times count from 0, which is taken to be 2026-09-21 14:13:20 UTC"]
    (tmp_path / "b.csv").write_text(table(times=SECONDS + START / 1e9))
    times, _, account = read(tmp_path / "b.csv", start=5)
    assert abs(times[0] - START) < 300
    assert load_record(tmp_path / "a.csv", (X, F), 100.0).values.shape == (500, 2)


def test_columns_are_called_as_channels_where_the_system_file_names_none(tmp_path: Path) -> None:
    path = tmp_path / "simulated.csv"
    path.write_text(table())
    _, values, _ = read(path, (Channel("x", "m", 1e-6), Channel("F", "N", 1.0)))
    np.testing.assert_allclose(values, VALUES, atol=1e-9)
    with pytest.raises(UnreadableRecording, match="names no columns"):
        read(path, (Channel("y", "m", 1e-6), Channel("G", "N", 1.0)))


@pytest.mark.parametrize(("text", "told"), [("", "it is empty"), ("1," * 600_000, "the first one is longer than 1 MB")])
def test_a_table_without_rows_says_why(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UnreadableRecording, match=told):
        read(tmp_path / "a.csv")


def test_columns_that_are_not_there_do_not_crowd_out_those_that_are(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(table())
    channels = [Channel(f"c{i}", "m", 1e-6, column=f"sensor_on_the_left_{i}") for i in range(60)]
    with pytest.raises(UnreadableRecording) as error:
        check(tmp_path / "a.csv", [*channels, Channel("x", "m", 1e-6, column="x_"), F])
    assert "'x_' (did you mean 'x'?)" in str(error.value) and "and 49 more" in str(error.value)
    assert str(error.value).endswith("its columns: time, x, F")
