"""A vehicle that stands: its fit is none, and its history has no line."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.core import Core
from tests.service_fakes import HOP, STANDING, START, make_window

RAN = [0, 1, *range(300, 420)]  # windows of half a second each; those between them are of a standing vehicle


@pytest.fixture
def stood(core: Core, system: System) -> str:
    levels = [0.1 if i in RAN else STANDING for i in range(440)]
    core.pipeline.process("a", [make_window(system, i, level) for i, level in enumerate(levels)])
    return "a"


def times(client: TestClient, resolution: float) -> tuple[list[int], list[int]]:
    """All points of the history and those that are of a standing vehicle, in ms."""
    name = client.get("/vehicles/a").json()["parameters"][0]["name"]
    asked = f"/vehicles/a/history?format=columns&parameter={name}&resolution={resolution}"
    return client.get(asked).json()["time"], client.get(f"/pages/vehicles/a/standing?resolution={resolution}").json()[
        "time"
    ]


@pytest.mark.parametrize("resolution", [0, 10, 60, 300, 3600])
def test_points_without_a_window_that_was_informative(client: TestClient, stood: str, resolution: int) -> None:
    every, still = times(client, resolution)
    width = resolution * 1000
    moved = {(START + i * HOP) // 10**6 for i in RAN}
    assert set(still) == {t for t in every if not any(t <= m < t + max(width, 1) for m in moved)}
    assert len(still) == {0: 318, 10: len(still), 60: len(still)}.get(resolution, 0)
    assert bool(still) == (resolution <= 60)


def test_since_and_until_bound_them(client: TestClient, stood: str) -> None:
    first = (START + 10 * HOP) / 1e9
    found = client.get(f"/pages/vehicles/a/standing?since={first}&until={first + 5}").json()["time"]
    assert found == [(START + i * HOP) // 10**6 for i in range(10, 20)]
    assert client.get("/pages/vehicles/a/standing?sinse=3").status_code == 422
    assert client.get("/pages/vehicles/b/standing").status_code == 404


def test_the_fit_that_is_shown_is_of_a_window_that_was_informative(client: TestClient, stood: str) -> None:
    assert ">0.030<" in client.get("/").text and "0.490" not in client.get("/").text
    page = client.get("/pages/vehicles/a").text
    assert "standing: the newest window tells nothing; when it last ran, fit NRMSE 0.030" in page
    assert "0.490" not in page and page.count("– standing") == len(
        client.get("/vehicles/a").json()["fit"]["per_sensor"]
    )


def test_a_vehicle_that_never_ran_has_no_fit(client: TestClient, core: Core, system: System) -> None:
    core.pipeline.process("b", [make_window(system, i, STANDING) for i in range(10)])
    assert "0.490" not in client.get("/").text + client.get("/pages/vehicles/b").text


def test_standing_is_no_circumstance(client: TestClient, stood: str) -> None:
    assert client.get("/vehicles/a/circumstances").json()["series"] == {}


def test_programs_learn_that_the_fit_of_a_standing_vehicle_says_nothing(
    client: TestClient, core: Core, system: System
) -> None:
    core.pipeline.process("c", [make_window(system, i, 0.1) for i in range(4)])
    assert 'sprung_fit_nrmse{sensor="car_1l",vehicle="c"}' in client.get("/metrics").text
    assert client.get("/vehicles/c").json()["fit"].get("reason") is None
    core.pipeline.process("c", [make_window(system, i, STANDING) for i in range(4, 8)])
    assert 'vehicle="c"' not in "".join(
        line for line in client.get("/metrics").text.splitlines() if line.startswith("sprung_fit_nrmse{")
    )
    assert "no excitation" in client.get("/vehicles/c").json()["fit"]["reason"]
