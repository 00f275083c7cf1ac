"""How vehicles ran, beside their histories: means of minutes and hours of loads, temperatures, speeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.model.system import MANCHESTER, System, load_system, parse_system
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.monitoring.views import running, window_dict
from sprung.service.settings import Settings
from sprung.service.store import Store, fleet
from sprung.service.store.circumstances import WindowCircumstances, add_circumstances, circumstances_between
from sprung.service.store.marks import remove
from sprung.service.store.schema import circumstances
from sprung.service.store.windows import Posterior, StoredEstimate, WindowLoads, WindowRecord
from tests.service_fakes import FakeIdentifier, make_window

SECOND = 10**9
HOUR = 3600 * SECOND
START = 1_790_000_000 // 3600 * HOUR


def test_means_are_of_all_windows_however_they_came(store: Store) -> None:
    rng = np.random.default_rng(1)
    loads = rng.uniform(0.0, 9e3, 7200)
    with store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
        for first in range(0, 7200, 700):  # in pieces that split minutes
            part = range(first, min(first + 700, 7200))
            ran = [
                WindowCircumstances(
                    START + i * SECOND, {"car.load": loads[i]} | ({"temperature": 3.0} if i < 60 else {})
                )
                for i in part
            ]
            add_circumstances(connection, {"a": ran}, 1)
        add_circumstances(connection, {"a": [WindowCircumstances(START, {})]}, 1)  # nothing known: nothing kept
        minutes = circumstances_between(connection, "a", START, START + 2 * HOUR, 2000)
        hours = circumstances_between(connection, "a", START, START + 2 * HOUR, 2)
        part_of = circumstances_between(connection, "a", START + HOUR, START + HOUR + 60 * SECOND, 2000)
    assert (minutes.resolution, len(minutes.time), hours.resolution) == (60, 120, 3600)
    assert np.allclose(np.array(minutes.values["car.load"], dtype=float), loads.reshape(120, 60).mean(axis=1))
    assert np.allclose(np.array(hours.values["car.load"], dtype=float), loads.reshape(2, 3600).mean(axis=1))
    assert minutes.values["temperature"][:2] == [3.0, None] and hours.values["temperature"] == [3.0, None]
    assert part_of.time[-1] == START + HOUR and part_of.values["car.load"]


def test_they_go_with_their_vehicle(store: Store) -> None:
    with store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
        add_circumstances(connection, {"a": [WindowCircumstances(START, {"speed": 20.0})]}, 1)
        remove(connection, "a")
        assert connection.execute(circumstances.select()).all() == []


@pytest.fixture
def warm(tmp_path: Path) -> System:
    """The bundled vehicle with a thermometer."""
    path = tmp_path / "warm.yaml"
    path.write_text(MANCHESTER.read_text() + "\ntemperature: {mcap: /car/temperature.outside}\n")
    return load_system(path)


@pytest.fixture
def client(warm: System, tmp_path: Path) -> Iterator[TestClient]:
    engine = Engine(warm, FakeIdentifier(warm), make_tracker(warm))
    core = build_core(Settings(data_dir=tmp_path / "data", min_free_bytes=0), engine)
    windows = [replace(make_window(warm, i), auxiliary=np.array([10.0 + i])) for i in range(20)]
    windows += [replace(make_window(warm, 20 + i), auxiliary=np.array([np.nan])) for i in range(4)]
    core.pipeline.process("a", windows[:15])
    core.pipeline.process("a", windows)  # some of them again: counted once
    with TestClient(create_app(core)) as running_client:
        yield running_client


def test_the_temperature_of_a_ride_is_reported(client: TestClient) -> None:
    found = client.get("/vehicles/a/circumstances").json()
    assert found["resolution"] == 60
    told = found["series"]["temperature"]
    assert told["unit"] == "degC"
    assert told["value"] == pytest.approx([10.0 + 19 / 2])  # all in one minute
    assert client.get("/vehicles/a/circumstances?until=1000").json()["series"] == {}
    assert client.get("/vehicles/nobody/circumstances").status_code == 404


def test_what_a_body_carries_stands_beside_what_was_measured(warm: System) -> None:
    window = replace(make_window(warm, 0), auxiliary=np.array([21.5]))
    assert running(warm, window, {"car": (3100.0, 40.0)}) == {"temperature": 21.5, "car.load": 3100.0}
    assert running(warm, replace(window, auxiliary=None), {}) == {}


@pytest.mark.parametrize("declared", [True, False])
def test_the_load_is_a_parameter_of_windows_where_the_system_file_names_it(declared: bool) -> None:
    text = MANCHESTER.read_text()
    empty = "position: [0.0, 0.0]}"
    system = parse_system(text.replace(empty, "position: [0.0, 0.0], load: true}", 1) if declared else text)
    engine = Engine(system, FakeIdentifier(system), make_tracker(system))
    P, S = len(system.tracked), len(system.sensors)
    solved = StoredEstimate(
        np.zeros(P), np.full(P, 0.01), np.ones(P, dtype=bool), 0.03, np.full(S, 0.03), 1.0, True, True, 2
    )
    loads = WindowLoads({"car": (3100.0, 400.0)}, {"car": (2950.0, 60.0)})
    record = WindowRecord(START, "used", None, 0, True, solved, Posterior(solved.log_ratio, solved.std), loads)
    line = window_dict(engine, record)
    told = {part: line[part].get("car.load") for part in ("estimate", "posterior")}
    assert told == ({"estimate": [3100.0, 400.0], "posterior": [2950.0, 60.0]} if declared else dict.fromkeys(told))
