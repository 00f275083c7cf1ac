"""The labelled recordings and the records made by others, where they lie beside the repository."""

import math
from collections import Counter
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
import yaml
from cantools.database.can import Database

from sprung.model.signals import Channel, Window
from sprung.replay import open_recording
from sprung.replay.record import load_record
from sprung.replay.recording import Recording
from sprung.replay.windowing import Windower

SHARED = Path(__file__).parents[3] / "shared"
RECORDINGS = SHARED / "recordings"
DBC = Path(__file__).parents[2] / "model" / "systems" / "bogie.dbc"
SYSTEM = Path(__file__).parents[2] / "model" / "systems" / "manchester.yaml"
pytestmark = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="no recordings beside the repository")


def train_channels() -> list[Channel]:
    """16 inputs, then 12 sensors."""
    system = yaml.safe_load(SYSTEM.read_text())
    found = [
        (f"{name}.{part}", item[part])
        for name, item in system["inputs"].items()
        for part in ("displacement", "velocity")
    ]
    found += list(system["sensors"].items())
    return [Channel(name, "", float(s["noise"]), s.get("mcap"), s.get("can"), s.get("csv")) for name, s in found]


CHANNELS = train_channels()


def windows_of(path: Path) -> tuple[Recording, Windower, list[Window]]:
    recording = open_recording(path, CHANNELS, dbc=DBC)
    windower = Windower(CHANNELS, 100.0, 100, 50, inputs=16)
    windows = [w for block in recording.blocks() for w in windower.push(block)] + windower.flush()
    return recording, windower, windows


@pytest.mark.parametrize(
    "pattern",
    ["case-00.mcap", "case-01.blf", "case-03.log", "case-05.asc", pytest.param("case-*", marks=pytest.mark.slow)],
)
def test_every_recording_is_read_whole(pattern: str) -> None:
    names = sorted(path.name for path in RECORDINGS.glob(pattern))
    assert names
    for name in names:
        recording, windower, windows = windows_of(RECORDINGS / name)
        assert recording.tally.as_dict() == {"used": 42000, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 0}
        assert not recording.incomplete
        assert recording.vehicle == ("demo-0001" if name.endswith("mcap") else None)
        assert Counter(w.outcome for w in windows) == {"used": 119}
        assert windows[0].start == 1_790_000_000_000_000_000
        assert windower.account.lost == 0


def test_the_ten_minutes_are_whole_and_on_the_cycle() -> None:
    recording, windower, windows = windows_of(RECORDINGS / "drift-600s.blf")
    assert recording.tally.used == 420_000
    assert [w.start for w in windows] == [1_790_000_000_000_000_000 + i * 500_000_000 for i in range(1199)]
    assert {w.outcome for w in windows} == {"used"}
    assert windower.account.expected == 600 * 100 * 28


@pytest.mark.parametrize("name", ["lossy-30s.mcap", "lossy-30s.blf"])
def test_every_lost_message_of_the_lossy_recordings_is_counted(name: str) -> None:
    recording, windower, windows = windows_of(RECORDINGS / name)
    came = recording.tally.used
    assert windower.account.expected == 3000 * 28
    assert windower.account.lost == 4 * (3000 * 7 - came)
    assert 0.01 < windower.account.lost / windower.account.expected < 0.03
    assert {w.outcome for w in windows} <= {"repaired", "dropped"}
    foreign = recording.tally.foreign
    assert foreign == (0 if name.endswith("mcap") else 1007)
    repaired = sum(w.repaired_samples for w in windows if w.outcome == "repaired")
    assert repaired > 1.5 * windower.account.lost  # each lies in two windows, but for dropped ones


def test_repaired_samples_are_close_to_the_lost_ones() -> None:
    """The lossy and the truncated recording are of one run in two formats: compare with the whole samples."""
    lossy = load_record(RECORDINGS / "lossy-30s.mcap", CHANNELS, 100.0)
    whole = load_record(RECORDINGS / "truncated-30s.mcap", CHANNELS, 100.0)
    length = len(whole.values)
    came = ~np.isnan(lossy.values[:length])
    same = np.abs(lossy.values[:length] - whole.values)[came]
    if np.median(same) > 0:
        pytest.skip("not the same run")
    _, _, windows = windows_of(RECORDINGS / "lossy-30s.mcap")
    scale = whole.values.std(axis=0)
    for window in windows[:30]:
        row = round((window.start - whole.start) / 1e7)
        error = np.abs(window.values - whole.values[row : row + 100]) / scale
        assert np.nanmax(error) < 1.0
        assert np.sqrt(np.nanmean(error[error > 0] ** 2)) < 0.2


def test_a_truncated_recording_is_read_to_the_cut() -> None:
    recording, _, windows = windows_of(RECORDINGS / "truncated-30s.mcap")
    assert recording.tally.used == 13451
    assert recording.incomplete
    assert len(recording.problems) == 1
    assert "after 19.2 s; 13451 messages recovered" in recording.problems[0]
    assert {w.outcome for w in windows} == {"used"}


def test_header_stamps_of_a_ros2_recording_are_even_where_its_log_times_are_not() -> None:
    path = SHARED / "benchmarks" / "mcap-real" / "tilt_laser.mcap"
    channels = [Channel(axis, "m/s^2", 0.1, mcap=f"/imu_data.linear_acceleration.{axis}") for axis in "xyz"]
    outcomes = {}
    for source in ("auto", "log"):
        recording = open_recording(path, channels, time_source=source)
        windower = Windower(channels, 20.0, 40, 20)
        windows = [w for block in recording.blocks() for w in windower.push(block)] + windower.flush()
        assert recording.tally.as_dict() == {"used": 356, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 3737}
        outcomes[source] = {w.outcome for w in windows}
        if source == "auto":
            assert abs(np.mean([w.values[:, 2].mean() for w in windows]) - 9.8) < 0.1  # it stands still
    assert outcomes["auto"] == {"used"}
    assert "used" not in outcomes["log"]


def test_a_real_car_log_decodes_as_with_cantools() -> None:
    folder = SHARED / "benchmarks" / "can-real"
    log, dbc = folder / "gt350-suspensionchange.log", folder / "ford_lincoln_base_pt.dbc"
    database = cantools.database.load_file(dbc, strict=False)
    frames = list(can.LogReader(log))
    assert isinstance(database, Database)
    known = {m.frame_id: m for m in database.messages}
    present = [known[i] for i in {f.arbitration_id for f in frames} & set(known)]
    channels = [Channel(f"{m.name}.{s.name}", "", 1.0, can=f"{m.name}.{s.name}") for m in present for s in m.signals]
    index = {channel.name: i for i, channel in enumerate(channels)}
    recording = open_recording(log, channels, dbc=database)
    found: dict[int, list[float]] = {i: [] for i in range(len(channels))}
    for block in recording.blocks():
        for channel, value in zip(block.channel.tolist(), block.value.tolist(), strict=True):
            found[channel].append(value)
    tally = recording.tally.as_dict()
    assert sum(tally.values()) == len(frames) == 13_072
    assert (tally["used"] + tally["dropped"], tally["corrupt"]) == (12_534, 0)
    missing = compared = 0
    place: Counter[int] = Counter()
    for frame in frames:
        message = known.get(frame.arbitration_id)
        if message is None:
            continue
        told = message.decode(bytes(frame.data), decode_choices=False)
        assert isinstance(told, dict)
        for name, truth in told.items():
            channel = index[f"{message.name}.{name}"]
            value = found[channel][place[channel]]
            place[channel] += 1
            compared += 1
            if np.isnan(value):
                missing += 1
            else:
                assert isinstance(truth, int | float) and math.isclose(value, truth, rel_tol=1e-12, abs_tol=1e-12)
    assert compared > 100_000
    assert missing == sum(recording.account.values.values()) > 0
