"""Recordings made by others, where they lie beside the repository: their owners do not license copies of them.

What they show is shown by made ones, too: decoding in test_can.py, header stamps in test_readers.py.
"""

import math
from collections import Counter
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from cantools.database.can import Database

from sprung.model.signals import Channel
from sprung.replay import open_recording
from sprung.replay.windowing import Windower

BESIDE = Path(__file__).parents[3] / "shared" / "benchmarks"
pytestmark = pytest.mark.skipif(not BESIDE.is_dir(), reason="no recordings beside the repository")


def test_header_stamps_of_a_ros2_recording_are_even_where_its_log_times_are_not() -> None:
    path = BESIDE / "mcap-real" / "tilt_laser.mcap"
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
    folder = BESIDE / "can-real"
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
