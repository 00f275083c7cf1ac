"""Comfort of the newest minute: in the metrics, on the vehicle's page, gone with the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.model.comfort import W_K
from sprung.model.signals import Window
from sprung.model.system import System
from sprung.model.tracking.tracker import TrackerState
from sprung.service.core import Core
from sprung.service.monitoring import rides
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.places import Places
from tests.service_fakes import make_window

FREQUENCY = 5.0  # Hz, a whole number of periods in a window


def shaken(system: System, number: int, amplitude: float) -> Window:
    """Window `number` of a car that moves by a sine at every accelerometer."""
    window = make_window(system, number)
    time = window.start * 1e-9 % 1000 + np.arange(system.window) / system.sample_rate
    values = window.values.copy()
    values[:, len(system.inputs) :] = amplitude * np.sin(2 * np.pi * FREQUENCY * time)[:, None]
    return replace(window, values=values)


@pytest.fixture
def riding(core: Core, system: System) -> str:
    core.pipeline.process("a", [shaken(system, number, 0.5) for number in range(140)])
    return "a"


def test_the_weighted_acceleration_of_a_minute_is_a_metric(client: TestClient, riding: str) -> None:
    text = client.get("/metrics").text
    line = f'sprung_comfort_meters_per_second_squared{{quantity="wk_rms",sensor="car_1l",vehicle="{riding}"}}'
    (value,) = (float(row.rpartition(" ")[2]) for row in text.splitlines() if row.startswith(line))
    expected = 0.5 / np.sqrt(2) * abs(W_K(np.array([2 * np.pi * FREQUENCY]))[0])
    assert value == pytest.approx(expected, rel=0.02)
    assert f'sprung_comfort_cost_ratio{{vehicle="{riding}"}}' in text


def test_the_page_shows_the_minute_and_what_leaving_the_baseline_costs(client: TestClient, riding: str) -> None:
    page = client.get(f"/pages/vehicles/{riding}").text
    assert "Ride comfort" in page
    assert "has changed the comfort by" in page


def test_before_a_whole_minute_nothing_is_said(client: TestClient, core: Core, system: System) -> None:
    core.pipeline.process("b", [shaken(system, number, 0.5) for number in range(60)])
    assert 'vehicle="b"' in client.get("/metrics").text
    assert "sprung_comfort_meters_per_second_squared{" not in client.get("/metrics").text
    assert "Ride comfort" not in client.get("/pages/vehicles/b").text


def test_a_deleted_vehicle_leaves_no_comfort_behind(client: TestClient, core: Core, riding: str) -> None:
    core.operations.remove("tester", riding)
    assert "sprung_comfort_meters_per_second_squared{" not in client.get("/metrics").text
    assert core.rides.latest(riding) is None


def test_vehicles_that_report_in_turns_keep_their_minutes(core: Core, system: System) -> None:
    core.rides._rides = Places(1, 120.0)
    for number in range(0, 140, 20):
        for vehicle in ("first", "second"):
            core.pipeline.process(vehicle, [shaken(system, n, 0.5) for n in range(number, number + 20)])
    assert core.rides.latest("first") is not None
    assert core.rides.latest("second") is None


def test_windows_do_not_wait_for_the_comfort_of_the_minute_that_they_end(
    core: Core, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Minutes of many vehicles end at once: foreseen one after the other they held up all windows for most of a
    second."""
    asked: list[TrackerState] = []
    real = rides.cost

    def counted(engine: Engine, state: TrackerState) -> float | None:
        asked.append(state)
        return real(engine, state)

    monkeypatch.setattr(rides, "cost", counted)
    core.pipeline.process("a", [shaken(system, number, 0.5) for number in range(140)])
    assert asked == []
    minute = core.rides.latest("a")
    assert minute is not None and minute.cost is not None
    assert len(asked) == 1
    assert core.rides.all() == {"a": minute} and len(asked) == 1  # remembered
