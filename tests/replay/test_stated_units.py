"""What a recording states of its units and time zones is compared with the system file, not passed over."""

from pathlib import Path

import numpy as np
import pytest

from sprung.model.address import TimeKey
from sprung.model.signals import Channel, TimeColumn
from sprung.replay import open_recording
from sprung.replay.account import Account
from sprung.replay.stamps import Stamps

ROWS = 40
NOON = 1_790_078_400_000_000_000  # 2026-09-22T12:00:00Z


def notes(path: Path, *channels: Channel, **options: object) -> list[str]:
    recording = open_recording(path, channels, **options)  # type: ignore[arg-type]
    for _ in recording.blocks():
        pass
    assert not recording.incomplete
    return recording.problems


def table(path: Path, header: str) -> Path:
    path.write_text(header + "".join(f"{i / 100},{np.sin(i / 9)},{np.cos(i / 9)}\n" for i in range(ROWS)))
    return path


X = Channel("x", "m", 1e-6, column="x")
F = Channel("F", "N", 1.0, column="F")


@pytest.mark.parametrize("header", ["t,x,F\ns,mm,N\n", "t [s],x [mm],F [N]\n"])
def test_a_unit_in_the_header_that_the_system_file_passes_over_is_told(tmp_path: Path, header: str) -> None:
    x = Channel("x", "m", 1e-6, column="x [mm]" if "[" in header else "x")
    f = Channel("F", "N", 1.0, column="F [N]" if "[" in header else "F")
    (line,) = [line for line in notes(table(tmp_path / "a.csv", header), x, f) if "states" in line]
    assert line.startswith("x: the recording states") and "in mm" in line and "`unit: mm`" in line


@pytest.mark.parametrize("gain", [1e-3, -1e-3, 1.02e-3])
def test_one_that_is_read_as_stated_needs_no_word(tmp_path: Path, gain: float) -> None:
    x = Channel("x", "m", 1e-6, column="x", gain=gain)
    assert not [line for line in notes(table(tmp_path / "a.csv", "t,x,F\ns,mm,N\n"), x, F) if "states" in line]


def test_another_scale_another_quantity_and_bare_volts_are_told(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "t,x,F\ns,m,V\n")
    lines = notes(path, Channel("x", "m", 1e-6, column="x", gain=1e-3), F)
    assert any("one of them is wrong" in line for line in lines if line.startswith("x:"))
    assert any("give `unit` and `scale`" in line for line in lines if line.startswith("F:"))
    (line,) = notes(table(tmp_path / "b.csv", "t,x,F\ns,mm,N\n"), Channel("a", "m/s^2", 1e-2, column="x"))
    assert "which is no unit of m/s^2" in line


def test_ends_of_names_and_unknown_units_are_no_contradiction(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "t,x_N,F\n")
    assert not notes(path, Channel("x", "m", 1e-6, column="x_N"), F)
    assert not notes(table(tmp_path / "b.csv", "t,x,F\ns,furlong,-\n"), X, F)


def test_the_units_of_a_can_database_count_too(tmp_path: Path) -> None:
    can, cantools = pytest.importorskip("can"), pytest.importorskip("cantools")
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: N\nBO_ 256 Road: 8 N\n'
        ' SG_ Z : 0|16@1- (0.001,0) [-32|32] "mm" N\n SG_ V : 16|16@1- (0.001,0) [-32|32] "m/s" N\n'
    )
    database = cantools.database.load_string(text)
    with can.BLFWriter(tmp_path / "a.blf") as writer:
        for i in range(ROWS):
            data = database.encode_message("Road", {"Z": 1.0, "V": 0.5})
            writer.on_message_received(
                can.Message(timestamp=1.79e9 + i / 100, arbitration_id=256, is_extended_id=False, data=data)
            )
    z, v = Channel("z", "m", 1e-6, can="Road.Z"), Channel("v", "m/s", 1e-3, can="Road.V")
    (line,) = notes(tmp_path / "a.blf", z, v, dbc=database)
    assert line == "z: the recording states Road.Z in mm, and it is read as m; give `unit: mm`"


def test_dates_without_a_zone_are_told_to_be_read_as_utc() -> None:
    account = Account()
    stamps, _ = Stamps(TimeColumn(), None, account).nanoseconds(["2026-09-22 12:00:00"])
    assert stamps.tolist() == [NOON]
    assert "no time zone" in account.problems[0] and not account.incomplete
    account = Account()
    Stamps(TimeColumn(), None, account).nanoseconds(["2026-09-22T12:00:00Z", "2026-09-22T14:00:00+02:00"])
    Stamps(TimeColumn(zone="UTC"), None, account).nanoseconds(["2026-09-22 12:00:00"])
    assert not account.problems


def test_local_dates_follow_their_zone_in_summer_and_winter() -> None:
    account = Account()
    stamps = Stamps(TimeColumn(zone="Europe/Berlin"), None, account)
    summer, winter, stated = stamps.nanoseconds(
        ["22.09.2026 14:00:00,5", "22.12.2026 14:00:00", "2026-09-22T12:00:00Z"]
    )[0]
    assert summer == NOON + 500_000_000 and stated == NOON
    assert winter == NOON + (91 * 24 + 1) * 3600 * 10**9
    assert not account.problems


def test_time_stamps_of_parquet_without_a_zone_do_too(tmp_path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    local = np.datetime64("2026-09-22T14:00:00", "ns") + np.arange(ROWS) * np.timedelta64(10, "ms")
    x = np.sin(np.arange(ROWS) / 9)
    pq.write_table(pa.table({"stamp": pa.array(local), "x": x}), tmp_path / "naive.parquet")
    pq.write_table(
        pa.table({"stamp": pa.array(local, pa.timestamp("ns", tz="UTC")), "x": x}), tmp_path / "aware.parquet"
    )
    assert "no time zone" in notes(tmp_path / "naive.parquet", X)[0]
    assert not notes(tmp_path / "aware.parquet", X)
    berlin = open_recording(tmp_path / "naive.parquet", [X], time=TimeColumn(zone="Europe/Berlin"))
    assert int(next(berlin.blocks()).time[0]) == NOON and not berlin.problems


def test_a_zone_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="is no time zone"):
        TimeKey(zone="Europe/Bärlin")
    assert TimeKey(zone="Europe/Berlin").as_column().zone == "Europe/Berlin"
