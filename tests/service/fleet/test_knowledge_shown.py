"""Trends of the fleet, as programs and people get it: the route, the fleet page, and who may see whose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store import fleet, history
from sprung.service.store.windows import Posterior, VehicleWindows, WindowRecord
from sprung.service.times import NANOSECONDS, now_ns

DAY = 86_400 * NANOSECONDS
DAYS = 12
WORN, DEPARTED = "north-02", "south-03"


def fill(core: Core, parameter: int) -> None:
    """Two classes of six; one day was cold in north; one of north wears by 1 % a day, one of south is 40 % off."""
    rng = np.random.default_rng(4)
    begin = (now_ns() // DAY - DAYS) * DAY
    count = len(core.engine.system.tracked)
    with core.store.write() as connection:
        for v in range(12):
            name = f"{'north' if v % 2 else 'south'}-{v // 2 + 1:02d}"
            fleet.ensure_vehicle(connection, name, begin)
            level = np.tile(0.02 * rng.normal(size=count), (DAYS, 1)) + 0.002 * rng.normal(size=(DAYS, count))
            level[:, parameter] -= 0.01 * np.arange(DAYS) * (name == WORN)
            level[:, parameter] -= np.log(1 / 0.6) * (name == DEPARTED)
            if v % 2:
                level[5] += 0.06
            std = np.full(count, 0.002)
            records = [
                WindowRecord(begin + day * DAY, "used", None, 0, True, None, Posterior(level[day], std))
                for day in range(DAYS)
            ]
            history.add_to_rollups(connection, [VehicleWindows(name, core.pipeline.model_id, records)], begin)


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    return build_core(Settings(data_dir=data_dir), engine)


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core)) as running:
        yield running


@pytest.fixture
def worn(core: Core) -> str:
    """The parameter that wears."""
    names = [p.name for p in core.engine.system.tracked]
    at = names.index("secondary_1l.damping")
    fill(core, at)
    return names[at]


def test_the_route_tells_the_fastest_the_worst_and_what_all_did(client: TestClient, worn: str) -> None:
    told = client.get("/fleet/knowledge?days=30&limit=3").json()
    first = told["fastest"][0]
    assert (first["vehicle"], first["parameter"]) == (WORN, worn)
    assert first["per_day"] == pytest.approx(-0.01, abs=4 * first["per_day_std"])
    low, middle, high = first["crossing_days"]
    assert 0 <= low < middle < high
    assert (told["worst"][0]["vehicle"], told["worst"][0]["parameter"]) == (DEPARTED, worn)
    assert told["worst"][0]["ratio"] == pytest.approx(0.6, rel=0.06)
    cold = [one for one in told["common"] if abs(one["change"]) > 0.03]
    assert cold and {one["vehicle_class"] for one in cold} == {"north"}
    assert len(told["worst"]) == len(told["fastest"]) == 3
    assert told["expected_crossings"]["365"] >= 0.9


def test_the_page_shows_them(client: TestClient, worn: str) -> None:
    page = client.get("/").text
    assert "Trends of the fleet" in page and "Furthest from its class" in page
    told = page[page.index("Trends of the fleet") :]
    for name in (WORN, DEPARTED):
        assert f'href="/pages/vehicles/{name}"' in told
    assert worn in told and "Left out of the trends" in told


def test_a_token_of_one_fleet_sees_that_fleet_alone(client: TestClient, worn: str) -> None:
    admin = client.post("/tokens", json={"name": "admin", "scopes": ["admin"], "fleet": ""}).json()["token"]
    headers = {"authorization": f"Bearer {admin}"}
    body = {"name": "south", "scopes": ["read"], "fleet": "south-"}
    south = client.post("/tokens", json=body, headers=headers).json()["token"]
    told = client.get("/fleet/knowledge?days=30", headers={"authorization": f"Bearer {south}"}).json()
    assert {one["vehicle_class"] for one in told["usual"]} == {"south"}
    assert all(one["vehicle"].startswith("south-") for one in told["fastest"] + told["worst"])


def test_an_empty_fleet_is_uninformative(client: TestClient) -> None:
    told = client.get("/fleet/knowledge").json()
    assert (told["parameters"], told["fastest"], told["worst"], told["usual"]) == (0, [], [], [])
    assert "Trends of the fleet" not in client.get("/").text


@pytest.mark.parametrize("query", ["days=2", "days=x", "limit=0", "limit=1000"])
def test_wrong_questions_are_refused(client: TestClient, query: str) -> None:
    assert client.get(f"/fleet/knowledge?{query}").status_code == 422
