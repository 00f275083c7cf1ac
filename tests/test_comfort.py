"""Comfort and running behaviour, against the standards' tables and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sprung.model.comfort import W_B, W_K, RideQuality, comfort_sensors, cost, foreseen, minute, running_band, weighted
from sprung.model.system import System, load_system

# ISO 2631-1:1997, table 3: W_k in thousandths at the one-third octaves from 0.4 to 80 Hz
TABLE_WK = {
    0.4: 352, 0.5: 418, 0.63: 459, 0.8: 477, 1: 482, 1.25: 484, 1.6: 494, 2: 531, 2.5: 631, 3.15: 804, 4: 967, 5: 1039,
    6.3: 1054, 8: 1036, 10: 988, 12.5: 902, 16: 768, 20: 636, 25: 513, 31.5: 405, 40: 314, 50: 246, 63: 186, 80: 132,
}  # fmt: skip


@pytest.fixture(scope="module")
def vehicle() -> System:
    return load_system()


@pytest.mark.parametrize(("nominal", "thousandths"), TABLE_WK.items())
def test_wk_is_the_table_of_iso_2631(nominal: float, thousandths: int) -> None:
    assert abs(W_K(np.array([2 * np.pi * nominal]))[0]) * 1000 == pytest.approx(thousandths, abs=1.0)


def test_wb_is_flat_where_people_are_most_sensitive_and_falls_as_bs_6841_says() -> None:
    """BS 6841's asymptotes: 0.4 from 0.5 to 2 Hz, f / 5 to 5 Hz, 1 to 16 Hz, 16 / f above."""
    for frequency in (1.0, 4.0, 8.0, 12.5, 31.5):
        asymptote = 0.4 if frequency < 2 else min(frequency / 5, 1.0, 16 / frequency)
        assert abs(W_B(np.array([2 * np.pi * frequency]))[0]) == pytest.approx(asymptote, rel=0.15)


def test_wb_below_and_above_wk_where_the_standards_differ() -> None:
    omega = 2 * np.pi * np.array([1.0, 31.5])
    low, high = np.abs(W_B(omega)) / np.abs(W_K(omega))
    assert low < 0.85 and high > 1.15


def test_a_sine_keeps_its_rms_times_the_weight() -> None:
    time = np.arange(6500) / 100
    sine = np.sqrt(2) * 0.3 * np.sin(2 * np.pi * 5 * time)[:, None]
    found = minute(sine, 100.0, 0)
    assert found.blocks[:, 0] == pytest.approx(0.3 * abs(W_B(np.array([10 * np.pi]))[0]), rel=1e-3)
    assert found.wk[0] == pytest.approx(0.3 * abs(W_K(np.array([10 * np.pi]))[0]), rel=1e-3)
    assert found.rms[0] == pytest.approx(0.3, rel=0.01)
    assert found.peak[0] == pytest.approx(0.3 * np.sqrt(2), rel=0.01)


def test_the_band_of_en_14363_passes_its_middle_and_halves_power_at_its_edges() -> None:
    gain = np.abs(running_band(2 * np.pi * np.array([0.1, 0.4, 2.0, 10.0, 40.0])))
    assert gain[[1, 3]] == pytest.approx(np.sqrt(0.5), rel=1e-3)
    assert gain[2] == pytest.approx(1.0, abs=1e-3)
    assert gain[[0, 4]].max() < 0.01


def test_minutes_are_the_same_however_windows_overlap(vehicle: System) -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(20_000, len(vehicle.channels)))
    straight, halves = RideQuality(vehicle), RideQuality(vehicle)
    for ride, hop in ((straight, 100), (halves, 50)):
        for at in range(0, len(values) - 99, hop):
            ride.push(at * 10_000_000, values[at : at + 100])
    assert len(straight.minutes) == len(halves.minutes) == 3
    for one, other in zip(straight.minutes, halves.minutes, strict=True):
        assert one.start == other.start
        assert np.allclose(one.blocks, other.blocks)
    assert straight.minutes[1].start - straight.minutes[0].start == 60_000_000_000
    start, sensors = straight.by_minute()[1]
    assert start == straight.minutes[1].start
    assert sensors["car_1l"]["wk_rms"] == straight.minutes[1].wk[0]
    assert sensors["car_1l"]["wb_rms"] == pytest.approx(np.sqrt(np.mean(straight.minutes[1].blocks[:, 0] ** 2)))


def test_a_gap_begins_a_new_minute_and_too_little_says_nothing(vehicle: System) -> None:
    ride = RideQuality(vehicle)
    values = np.random.default_rng(2).normal(size=(4000, len(vehicle.channels)))
    ride.push(0, values)
    ride.push(100_000_000_000, values)
    assert ride.summary() == {"minutes": 0, "sensors": {}}


def test_mean_comfort_needs_five_minutes(vehicle: System) -> None:
    ride = RideQuality(vehicle)
    values = np.random.default_rng(3).normal(size=(6000, len(vehicle.channels)))
    told: list[dict[str, Any]] = []
    for number in range(6):
        ride.push(number * 60_000_000_000, values)
        told.append(ride.summary())
    assert told[3]["sensors"]["car_1l"]["n_mv_vertical"] is None
    last = told[-1]["sensors"]["car_1l"]
    assert last["n_mv_vertical"] == pytest.approx(6 * last["wb_p95"])


def test_people_are_where_nothing_stands_on_top(vehicle: System) -> None:
    assert [vehicle.sensors[i] for i in comfort_sensors(vehicle)] == ["car_1l", "car_1r", "car_2l", "car_2r"]


def test_foreseen_comfort_is_what_a_simulated_ride_has(vehicle: System) -> None:
    from dataclasses import replace

    from sprung.benchmarks.generator.ride import draw_ride, record
    from sprung.benchmarks.generator.track import LOW_TRACK

    rng = np.random.default_rng(4)
    ride = replace(draw_ride(rng), load=0.0, speed=40.0, level=LOW_TRACK, own_share=0.0, coherence=0.5)
    values = record(rng, ride, 240.0)[:, :4]
    seen = np.sqrt((weighted(values, 100.0, W_B)[500:] ** 2).mean(axis=0))
    assert foreseen(vehicle, ride.log_ratio) == pytest.approx(seen, rel=0.1)


def test_a_failed_damper_costs_comfort_and_no_change_costs_nothing(vehicle: System) -> None:
    healthy = np.zeros(24)
    failed = healthy.copy()
    failed[20] = np.log(0.2)  # of secondary_1l's damping
    worse = cost(vehicle, failed, healthy)
    assert worse is not None and 0.01 < worse < 1.0
    assert cost(vehicle, healthy, healthy) == 0.0
