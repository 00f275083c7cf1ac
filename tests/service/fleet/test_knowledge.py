"""What a fleet tells, against fleets whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.service.fleet.knowledge import (
    crossing_days,
    fastest,
    kind_of,
    knowledge,
    probability,
    sure_slope,
    usual_levels,
    worst,
)
from sprung.service.store import Store, fleet, history
from sprung.service.store.circumstances import WindowCircumstances, add_circumstances
from sprung.service.store.levels import FleetLevels, fleet_levels
from sprung.service.store.windows import VehicleWindows, add_windows
from tests.service.store.test_store import DAY, HOP, START, record

NAMES = ("secondary_1l.damping", "secondary_2l.damping", "primary_11l.stiffness")
DAYS = 20
STD = 0.004


def fleet_of_truth(rng: np.random.Generator, vehicles: int = 40) -> tuple[FleetLevels, np.ndarray]:
    """Two classes 0.1 apart, vehicles spread by 0.03, a warm week that all of north have in common, one that wears."""
    names = tuple(f"{'north' if v % 2 else 'south'}-{v:03d}" for v in range(vehicles))
    own = 0.03 * rng.normal(size=(vehicles, 3)) + np.where(np.arange(vehicles) % 2, 0.1, 0.0)[:, None]
    level = np.repeat(own[:, None, :], DAYS, axis=1)
    level[1::2, 8:15, :2] -= 0.05
    level[7, :, 0] -= 0.01 * np.arange(DAYS)
    level += STD * rng.normal(size=level.shape)
    time = np.repeat(START // DAY * DAY + np.arange(DAYS)[None] * DAY, vehicles, axis=0)
    return FleetLevels(names, time, level, np.full(level.shape, STD)), own


def test_the_worst_the_fastest_and_the_common_mode_are_found() -> None:
    found, own = fleet_of_truth(np.random.default_rng(1))
    told = knowledge(found, NAMES, 0.25, 0.2)
    first = fastest(told.standings, 5)
    assert (first[0].vehicle, first[0].parameter) == ("north-007", NAMES[0])
    assert first[0].slope == pytest.approx(-0.01, abs=4 * first[0].slope_std)
    assert worst(told.standings, 1)[0].vehicle == "north-007"
    assert all(sure_slope(one) < 0.002 for one in first[1:])
    assert {(one.vehicle_class, one.kind) for one in told.common if abs(one.change) > 0.03} == {
        ("north", "secondary.damping")
    }
    changes = [one.change for one in told.common if one.change < -0.03]
    assert len(changes) == 7 and np.mean(changes) == pytest.approx(-0.05, abs=0.01)
    usual = {(one.vehicle_class, one.kind): one for one in told.usual}
    for name, rows in (("south", slice(0, None, 2)), ("north", slice(1, None, 2))):
        one = usual[name, "primary.stiffness"]
        assert one.mean == pytest.approx(own[rows, 2].mean(), abs=3 * one.mean_std)
        assert one.own_std == pytest.approx(0.03, rel=0.35)
        assert one.vehicles == 20


def test_a_common_mode_that_follows_the_temperature_says_so() -> None:
    """Dampers of one class lose 0.4 % a degree; springs and the other class do nothing of the kind."""
    found, _ = fleet_of_truth(np.random.default_rng(3))
    warm = 10 + 8 * np.sin(np.arange(DAYS)) + 0.5 * np.random.default_rng(4).normal(size=(len(found.vehicles), DAYS))
    level = found.level.copy()
    level[1::2, 8:15, :2] += 0.05  # without the warm week
    level[::2, :, :2] -= 0.004 * (10 + 8 * np.sin(np.arange(DAYS)))[None, :, None]
    told = knowledge(replace(found, level=level, temperature=warm), NAMES, 0.25, 0.2)
    assert [(one.vehicle_class, one.kind) for one in told.temperature] == [("south", "secondary.damping")]
    one = told.temperature[0]
    assert one.per_kelvin == pytest.approx(-0.004, abs=max(4 * one.std, 2e-4)) and one.explained > 0.9
    assert one.days == DAYS
    assert knowledge(replace(found, level=level), NAMES, 0.25, 0.2).temperature == ()
    worn = fastest(told.standings, 1)[0]
    assert worn.vehicle == "north-007"


def test_quiet_vehicles_stay_quiet() -> None:
    """Slopes of vehicles that do not change: beyond 95 % as often as it says, on both sides together."""
    rng = np.random.default_rng(5)
    level = 0.03 * rng.normal(size=(200, 1, 3)) + STD * rng.normal(size=(200, DAYS, 3))
    time = np.repeat(START // DAY * DAY + np.arange(DAYS)[None] * DAY, 200, axis=0)
    names = tuple(f"north-{v:03d}" for v in range(200))
    told = knowledge(FleetLevels(names, time, level, np.full(level.shape, STD)), NAMES, 0.25, 0.2)
    share = np.mean([sure_slope(one) > 0 for one in told.standings])
    assert 0.04 < share < 0.16
    departures = np.array([one.departure for one in told.standings])
    assert np.std(departures) == pytest.approx(1.0, abs=0.15)


def test_the_interval_of_the_crossing_covers_the_truth() -> None:
    """Vehicles that wear along a line: when they cross is told within its 5 and 95 % for nine of ten."""
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(400):
        slope, std, slope_std = -0.002, 0.01, 0.0004
        moved = -0.05
        seen_moved, seen_slope = moved + std * rng.normal(), slope + slope_std * rng.normal()
        low, middle, high = crossing_days(seen_moved, std, seen_slope, slope_std, 0.2)
        truth = (0.2 - 0.05) / 0.002
        assert low is not None and middle is not None and low < middle
        inside += low <= truth and (high is None or truth <= high)
    assert 0.86 < inside / 400 < 0.94


def test_a_line_that_goes_nowhere_crosses_nothing() -> None:
    assert crossing_days(0.0, 0.01, 1e-6, 1e-6, 0.2)[1:] == (None, None)
    assert crossing_days(0.0, 0.01, float("nan"), 0.1, 0.2) == (None, None, None)
    assert crossing_days(0.3, 0.01, 0.001, 1e-6, 0.2)[0] == 0.0
    assert probability(100.0, 0.0, 0.01, 0.002, 1e-6, 0.2) == pytest.approx(0.5, abs=1e-3)


def test_a_class_of_few_is_drawn_towards_the_others() -> None:
    rng = np.random.default_rng(2)
    classes = np.array(["a"] * 50 + ["b"] * 50 + ["c"])
    level = np.r_[0.02 * rng.normal(size=(100, 1)), [[0.2]]]
    told = usual_levels("x", level, np.full((101, 1), 0.01), classes)
    assert [one.vehicle_class for one in told] == ["a", "b", "c"]
    assert 0.0 < told[2].mean < 0.2
    assert told[2].mean_std > told[0].mean_std


@pytest.mark.parametrize(
    ("parameter", "kind"),
    [
        ("secondary_1l.damping", "secondary.damping"),
        ("primary_11l.stiffness", "primary.stiffness"),
        ("car.mass", "car.mass"),
        ("k1.stiffness", "k.stiffness"),
    ],
)
def test_a_type_is_the_name_without_its_number(parameter: str, kind: str) -> None:
    assert kind_of(parameter) == kind


def test_levels_of_a_fleet_are_read_from_hours(any_store: Store) -> None:
    with any_store.write() as connection:
        model = fleet.ensure_model(connection, "digest", "toy", {}, START)
        for v, vehicle in enumerate(("north-1", "north-2", "south-1")):
            fleet.ensure_vehicle(connection, vehicle, START)
            hours = [(day, day * (DAY // HOP) + hour * 7200) for day in range(4) for hour in (0, 2)]
            rows = [record(number, level=0.01 * day + v) for day, number in hours]
            stored = [VehicleWindows(vehicle, model, rows)]
            add_windows(connection, stored, START, None)
            history.add_to_rollups(connection, stored, START)
            ran = [WindowCircumstances(row.start, {"temperature": 5.0 + v}) for row in rows] if v else []
            add_circumstances(connection, {vehicle: ran}, START)
    with any_store.read() as connection:
        found = fleet_levels(connection, model, START // DAY * DAY, START // DAY * DAY + 5 * DAY, 5)
        north = fleet_levels(connection, model, START // DAY * DAY, START // DAY * DAY + 5 * DAY, 5, "north-")
    assert found.vehicles == ("north-1", "north-2", "south-1")
    assert north.vehicles == ("north-1", "north-2")
    points = found.level[2, found.time[2] > 0, 0]
    np.testing.assert_allclose(points, 2 + 0.01 * np.arange(4))
    assert np.isnan(found.level[0, found.time[0] == 0]).all()
    assert found.temperature is not None and np.isnan(found.temperature[0]).all()
    np.testing.assert_allclose(found.temperature[2, found.time[2] > 0], 7.0)
