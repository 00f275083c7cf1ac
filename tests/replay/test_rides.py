"""Whole rides of the bundled vehicle, and what was lost of them, from file to windows."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sprung.model.signals import FloatArray, Window
from sprung.model.system import MANCHESTER_DBC, System
from sprung.replay import open_recording
from sprung.replay.record import load_record
from sprung.replay.recording import Recording
from sprung.replay.windowing import Windower
from tests.rides import MESSAGES, VEHICLE, RecordedRide, cut_off, make_ride, with_losses

DRIFT = Path(__file__).parents[1] / "data" / "drift-600s.blf"
START = 1_790_000_000_000_000_000
SECONDS = 30


def windows_of(path: Path, system: System) -> tuple[Recording, Windower, list[Window]]:
    recording = open_recording(path, system.channels, dbc=MANCHESTER_DBC)
    windower = Windower(system.channels, 100.0, 100, 50, needed=system.needed)
    windows = [w for block in recording.blocks() for w in windower.push(block)] + windower.flush()
    return recording, windower, windows


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> RecordedRide:
    return make_ride(tmp_path_factory.mktemp("ride") / "whole.mcap", SECONDS, seed=3)


def in_order(ride: RecordedRide, system: System) -> FloatArray:
    """The true samples, in the order of the system's channels."""
    return ride.values[:, [ride.channels.index(channel.name) for channel in system.channels]]


@pytest.mark.parametrize("kind", ["mcap", "blf", "log", "asc"])
def test_every_format_is_read_whole(kind: str, tmp_path: Path, system: System) -> None:
    made = make_ride(tmp_path / f"ride.{kind}", SECONDS, seed=3)
    recording, windower, windows = windows_of(made.path, system)
    messages = 100 * SECONDS * MESSAGES
    assert recording.tally.as_dict() == {"used": messages, "repaired": 0, "dropped": 0, "corrupt": 0, "foreign": 0}
    assert not recording.incomplete
    assert recording.vehicle == (VEHICLE if kind == "mcap" else None)
    assert Counter(w.outcome for w in windows) == {"used": 2 * SECONDS - 1}
    assert windows[0].start == START
    assert windower.account.lost == 0
    rounding = 1e-6 if kind == "mcap" else np.array([*8 * [1e-6, 2e-5], *4 * [5e-4], *8 * [2e-3]])
    error = np.abs(windows[3].values - in_order(made, system)[150:250])
    assert np.all(error <= 0.51 * rounding + 1e-6 * np.abs(windows[3].values))


def test_ten_minutes_are_whole_and_on_the_cycle(system: System) -> None:
    recording, windower, windows = windows_of(DRIFT, system)
    assert recording.tally.used == 420_000
    assert [w.start for w in windows] == [START + i * 500_000_000 for i in range(1199)]
    assert {w.outcome for w in windows} == {"used"}
    assert windower.account.expected == 600 * 100 * 28


@pytest.mark.parametrize("kind", ["mcap", "blf"])
def test_every_lost_message_is_counted(kind: str, tmp_path: Path, system: System) -> None:
    whole = make_ride(tmp_path / f"whole.{kind}", SECONDS, seed=3)
    lossy = with_losses(whole, tmp_path / f"lossy.{kind}")
    recording, windower, windows = windows_of(lossy.path, system)
    assert recording.tally.used == 100 * SECONDS * MESSAGES - lossy.lost
    assert recording.tally.foreign == lossy.foreign
    assert windower.account.expected == 100 * SECONDS * 28
    assert windower.account.lost == 4 * lossy.lost
    assert {w.outcome for w in windows} <= {"repaired", "dropped"}
    repaired = sum(w.repaired_samples for w in windows if w.outcome == "repaired")
    assert repaired > 1.5 * windower.account.lost  # each lies in two windows, but for dropped ones


def test_repaired_samples_are_close_to_the_lost_ones(ride: RecordedRide, tmp_path: Path, system: System) -> None:
    lossy = with_losses(ride, tmp_path / "lossy.mcap")
    came = load_record(lossy.path, system.channels, 100.0)
    truth = in_order(ride, system)
    missing = np.isnan(came.values)
    assert missing.sum() == pytest.approx(4 * lossy.lost, abs=8)  # but for a first or last sample
    _, _, windows = windows_of(lossy.path, system)
    scale = truth.std(axis=0)
    errors = []
    for window in windows:
        row = round((window.start - START) / 1e7)
        if window.outcome == "repaired":
            errors.append((np.abs(window.values - truth[row : row + 100]) / scale)[missing[row : row + 100]])
    error = np.concatenate(errors)
    assert len(error) > 1.5 * 4 * lossy.lost
    assert np.nanmax(error) < 1.0
    assert np.sqrt(np.nanmean(error**2)) < 0.2


def test_a_recording_that_was_cut_off_is_read_to_the_cut(ride: RecordedRide, tmp_path: Path, system: System) -> None:
    recording, _, windows = windows_of(cut_off(ride, tmp_path / "cut.mcap", 0.64).path, system)
    assert 0.55 < recording.tally.used / (100 * SECONDS * MESSAGES) < 0.75
    assert recording.incomplete
    assert len(recording.problems) == 1
    seconds = recording.tally.used / (100 * MESSAGES)
    assert f"after {seconds:.1f} s; {recording.tally.used} messages recovered" in recording.problems[0]
    assert {w.outcome for w in windows[:-1]} == {"used"}  # the cut may go through the last one's last samples
