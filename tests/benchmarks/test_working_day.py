"""The generator's working day: what is drawn, and whether it is the vehicle that it says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sprung.benchmarks.generator import read_vehicle
from sprung.benchmarks.generator.dayfile import write_day
from sprung.benchmarks.generator.running import Rails, modes, run_day
from sprung.benchmarks.generator.timetable import Fault, Service, draw_timetable
from sprung.benchmarks.generator.track import LOW_TRACK, errib176
from sprung.model.identification.identify import Identifier
from sprung.model.system import MANCHESTER, MANCHESTER_DBC, load_system
from sprung.replay import open_recording

VEHICLE = read_vehicle(MANCHESTER)
PLAIN = Service(
    load=(0.0, 0.0), off_centre=0.0, clock=0.0, gain_drift=0.0, temperature=(20.0, 20.0), daily_swing=0.0,
    warm_up=0.0, wear=0.0, curves=0.0, joints=0.0, switches=False, dwell=(20.0, 20.0), cruise=(40.0, 40.0),
)  # fmt: skip


def test_stops_come_as_often_as_the_service_says_and_the_train_stands_there() -> None:
    timetable = draw_timetable(VEHICLE, Service(), 7200.0, 1)
    standing = timetable.speed == 0
    arrivals = timetable.time[1:][standing[1:] & ~standing[:-1]]
    assert np.all((np.diff(arrivals) > 150) & (np.diff(arrivals) < 510))
    assert 40 < timetable.speed.max() <= 50.0
    loads = np.unique(timetable.load[timetable.speed > 5].round(9))
    assert len(loads) == len(timetable.stations)  # one between every two stops
    assert np.all(np.abs(loads) <= 0.3)


def test_a_standing_train_shows_noise_and_a_running_one_its_own_values() -> None:
    timetable = draw_timetable(VEHICLE, PLAIN, 80.0, 2)
    values = np.concatenate(list(run_day(VEHICLE, timetable)))
    noise = np.concatenate([VEHICLE.input_noise.ravel(), VEHICLE.sensor_noise])
    assert np.allclose(values[50:350].std(axis=0) / noise, 1.0, atol=0.2)  # doors are still closed
    system = load_system()
    columns = [VEHICLE.channels.index(channel.name) for channel in system.channels]
    windows = np.stack([values[at : at + 100, columns] for at in range(6000, 7900, 100)])
    found = Identifier(system).identify(windows)
    assert all(e.adequate for e in found)
    error = np.mean([e.log_ratio for e in found], axis=0) - timetable.own
    std = np.sqrt(np.mean([np.diag(e.covariance) for e in found], axis=0) / len(found))
    assert np.abs(error / std).max() < 4.0


def test_a_rail_has_the_spectrum_that_it_is_drawn_from() -> None:
    timetable = replace(draw_timetable(VEHICLE, PLAIN, 60.0, 3), service=replace(PLAIN, level=(1.0, 1.0)))
    heights = Rails(timetable, 100_000.0, LOW_TRACK).at(1.0, np.arange(0, 100_000, 0.1))
    power = np.abs(np.fft.rfft(heights)) ** 2 * 0.1 / len(heights) * 2 / (2 * np.pi)
    wave = 2 * np.pi * np.fft.rfftfreq(len(heights), 0.1)
    band = (wave > 0.2) & (wave < 2.5)
    assert np.mean(power[band] / errib176(wave[band].astype(float), LOW_TRACK)) == pytest.approx(1.0, abs=0.05)


def test_the_load_is_where_the_timetable_puts_it() -> None:
    """A load in front of the middle presses more on the front springs: the pitch responds to a vertical force."""
    still = modes(VEHICLE, np.zeros(24), 0.3, 0.0, np.ones(2))
    ahead = modes(VEHICLE, np.zeros(24), 0.3, 2.0, np.ones(2))
    force = np.zeros(19)
    force[18] = 1.0
    front, rear = (VEHICLE.sensors.index(name) for name in ("car_1l", "car_2l"))
    assert still.shown[front] @ np.zeros(18) + still.direct[front] @ force == pytest.approx(
        still.direct[rear] @ force, rel=1e-9
    )
    assert ahead.direct[front] @ force < ahead.direct[rear] @ force


def test_faults_change_what_they_name() -> None:
    faults = (Fault("secondary_1l.damping", 30.0, 0.8), Fault("bogie1_1l.gain", 10.0, 1.05, 20.0))
    timetable = draw_timetable(VEHICLE, replace(PLAIN, faults=faults), 60.0, 4)
    before, after = (timetable.log_ratio(VEHICLE, t) for t in (29.0, 31.0))
    change = after - before
    row = 12 + VEHICLE.elements.index("secondary_1l")
    assert change[row] == pytest.approx(np.log(0.8))
    assert np.count_nonzero(np.abs(change) > 1e-6) == 1
    gains = timetable.gains(VEHICLE.channels, np.array([0.0, 20.0, 40.0]))
    assert gains[:, VEHICLE.channels.index("bogie1_1l")] == pytest.approx([1.0, 1.05**0.5, 1.05], rel=1e-6)


@pytest.mark.parametrize("kind", ["blf", "mcap"])
def test_a_day_is_read_back_by_the_product(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"day.{kind}"
    write_day(VEHICLE, PLAIN, 25.0, 5, path)
    system = load_system()
    recording = open_recording(path, system.channels, dbc=MANCHESTER_DBC)
    count = sum(len(block.time) for block in recording.blocks())
    assert count == 2500 * 28
    assert recording.problems == []
