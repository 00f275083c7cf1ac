"""Pages as a person's browser asks for them: those that do not exist, and lists that are longer than a page."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.tracking.state import Alarm
from sprung.service.api.fleet import load_view
from sprung.service.core import Core
from sprung.service.monitoring.views import VehicleView
from sprung.service.rendering.render import with_std
from sprung.service.sources.live import FeedStatus
from sprung.service.store import fleet, work
from sprung.service.store.work import JobRow

BROWSER = {"accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
FIRST = Alarm("change", "primary_11l.damping", 0, 1, "warning", -0.1, 0.02)


@pytest.mark.parametrize("path", ["/pages/vehicles/nope", "/pages/nope", "/nope", "/reports/nope/page"])
def test_a_page_that_does_not_exist_is_said_in_a_page(client: TestClient, path: str) -> None:
    answer = client.get(path, headers=BROWSER)
    assert answer.status_code == 404 and answer.headers["content-type"].startswith("text/html")
    assert '<a href="/">Back to the fleet</a>' in answer.text and "<h1>Not Found" in answer.text
    for headers in ({"accept": "*/*"}, {"accept": "application/json"}, {"accept": "application/json, text/html"}):
        plain = client.get(path, headers=headers)
        assert (plain.status_code, plain.headers["content-type"]) == (404, "application/problem+json")


def test_a_vehicle_of_which_nothing_was_heard_is_not_called_good(client: TestClient, core: Core) -> None:
    core.pipeline.process("new", [])
    for path in ("/", "/pages/vehicles/new"):
        page = client.get(path, headers=BROWSER).text
        assert "no window yet" in page and '<span class="badge ok">' not in page
    listed, alone = client.get("/vehicles").json(), client.get("/vehicles/new").json()
    for one in (listed["vehicles"][0], alone):
        assert (one["vehicle"], one["health"], one["last_window"]) == ("new", "check_function", None)
    assert (listed["counts"]["ok"], listed["counts"]["check_function"]) == (0, 1)
    assert client.get("/vehicles?health=ok").json()["vehicles"] == []


def test_a_page_never_repeats_a_path_as_markup(client: TestClient) -> None:
    answer = client.get("/pages/vehicles/%3Cscript%3E", headers=BROWSER)
    assert answer.status_code == 404 and "<script>" not in answer.text and "&lt;script&gt;" in answer.text


def test_what_is_sent_wrongly_is_answered_to_programs(client: TestClient) -> None:
    assert client.post("/identify", json={}, headers=BROWSER).headers["content-type"] == "application/problem+json"
    wrong = client.get("/pages/alarms?actve=false", headers=BROWSER)
    assert wrong.status_code == 422 and "actve is not a query parameter here" in wrong.text


@pytest.fixture
def alarmed(client: TestClient, core: Core) -> int:
    """120 alarms, every third of which is closed."""
    found = [replace(FIRST, opened=i, closed=None if i % 3 else 500) for i in range(1, 121)]
    with core.store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
        fleet.save_alarms(connection, "a", core.pipeline.model_id, found)
    return len(found)


@pytest.mark.parametrize(("active", "total"), [("", 80), ("active=false", 120)])
def test_alarms_are_paged_to_the_last_one(client: TestClient, alarmed: int, active: str, total: int) -> None:
    address, seen, pages = f"/pages/alarms?{active}", [], 0
    while address:
        page = client.get(address)
        assert page.status_code == 200
        seen += re.findall(r'"Since">([^<]+)<', page.text)
        states = re.findall(r'"State">(<button|<span class="soft">recovered)', page.text)
        assert active or not any("recovered" in one for one in states)
        following = re.search(r'<a href="([^"]+)" rel="next"', page.text)
        address, pages = following[1].replace("&amp;", "&") if following else "", pages + 1
    assert (len(seen), pages) == (total, -(-total // 50))
    assert 'rel="prev"' in client.get(f"/pages/alarms?page=2&{active}").text


def test_a_page_of_alarms_behind_the_last_leads_back(client: TestClient, alarmed: int) -> None:
    text = client.get("/pages/alarms?page=9").text
    assert "None on this page" in text and 'href="/pages/alarms?page=2" rel="prev"' in text
    for wrong in ("page=0", "page=x", "active=perhaps", "pge=2"):
        assert client.get(f"/pages/alarms?{wrong}").status_code == 422


def test_a_page_of_the_fleet_behind_the_last_leads_back(client: TestClient, broken: str) -> None:
    text = client.get("/?page=9&sort=id").text
    assert "None on this page" in text and "No vehicle yet" not in text
    assert 'href="/?sort=id" rel="prev"' in text


def test_nobody_is_asked_for_a_token_before_there_is_one(client: TestClient, core: Core) -> None:
    assert "nobody needs to sign in" in client.get("/signin").text
    core.tokens.create("anna", ["read"])
    assert 'name="token"' in client.get("/signin").text


def test_what_an_alarm_is_not_distinguished_from_stays_beside_it(client: TestClient, core: Core) -> None:
    rivals = ("bogie1_1l.gain", "bogie1_1l.delay")
    with core.store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
        fleet.save_alarms(connection, "a", core.pipeline.model_id, [replace(FIRST, closed=2, alternatives=rivals)])
    (alarm,) = client.get("/vehicles/a/alarms").json()["alarms"]
    assert alarm["alternatives"] == list(rivals)
    for page in ("/pages/vehicles/a", "/pages/alarms?active=false"):
        assert "bogie1_1l.gain or bogie1_1l.delay or " in client.get(page).text


def test_an_alarm_of_a_sensor_leads_to_the_sensors_and_one_of_a_spring_to_its_history(
    client: TestClient, core: Core
) -> None:
    with core.store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
        wrong = replace(FIRST, kind="sensor", parameter="bogie1_1l.gain", change=0.06)
        fleet.save_alarms(connection, "a", core.pipeline.model_id, [FIRST, wrong])
    page = client.get("/pages/vehicles/a").text
    assert 'data-parameter="primary_11l.damping">history' in page
    assert 'data-parameter="bogie1_1l.gain"' not in page and '<a href="#sensors">measured against simulated' in page


@pytest.mark.parametrize(("path", "name"), [("/", "Fleet"), ("/pages/alarms", "Alarms"), ("/pages/work", "Work")])
def test_people_are_told_where_they_are(client: TestClient, path: str, name: str) -> None:
    assert re.findall(r'aria-current="page">(\w+)<', client.get(path).text) == [name]


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (1_233_000.0, 14_460.0, "N/m", "1.233 ± 0.014 MN/m"),
        (3632.0, 64.63, "N s/m", "3.632 ± 0.065 kN s/m"),
        (464_700.0, 5413.0, "N/m", "464.7 ± 5.4 kN/m"),
        (1_220_000.0, 610_000.0, "N/m", "1.22 ± 0.61 MN/m"),
        (29_200.0, 410.0, "kg", "29200 ± 410 kg"),
        (12.0, 0.0, "N/m", "12 N/m"),
    ],
)
def test_a_value_and_its_deviation_have_one_unit(value: float, std: float, unit: str, text: str) -> None:
    assert " ".join(filter(None, with_std(value, std, unit))) == text


def test_jobs_that_wait_or_run_can_be_cancelled_where_they_are_listed(client: TestClient, core: Core) -> None:
    with core.store.write() as connection:
        for state in ("queued", "running", "done", "failed"):
            work.add_job(connection, JobRow(state, "recording", state, None, None, 0.2, None, None, 1, 1))
    offered = re.findall(r'data-post="/jobs/(\w+)/cancel"', client.get("/pages/work").text)
    assert sorted(offered) == ["queued", "running"]


def test_the_page_of_work_shows_live_buses_and_what_is_wrong_with_them(client: TestClient, core: Core) -> None:
    assert "Live buses" not in client.get("/pages/work").text
    down = FeedStatus("socketcan:can0", "car-17", "down", "no such device", 0.0, 3, 2, 1, 5, 4)
    core.feeds = [SimpleNamespace(status=lambda: down)]  # type: ignore[list-item]
    shown = client.get("/pages/work").text
    for text in ("Live buses", "socketcan:can0", "no such device", "3 waiting, 3 lost", "5 frames lost"):
        assert text in shown


RECORDED = {"recording": "r", "vehicle": "tram", "windows": {"used": 7, "repaired": 0, "dropped": 2}}
REPORTED = {"report": "one", "verdict": "missing_physics"}


def test_the_page_of_work_says_what_came_of_recordings_and_diagnoses(client: TestClient, core: Core) -> None:
    ended: list[tuple[str, str, dict[str, Any] | None, str | None]] = [
        ("recording", "done", RECORDED, None),
        ("diagnosis", "done", REPORTED, None),
        ("recording", "failed", None, "the file is empty"),
    ]
    with core.store.write() as connection:
        for number, (kind, state, result, error) in enumerate(ended):
            work.add_job(connection, JobRow(str(number), kind, state, None, None, 1.0, result, error, number, number))
    page = client.get("/pages/work")
    assert page.status_code == 200, page.text
    assert "7 windows used, 0 repaired, 2 dropped" in page.text and "report: missing physics" in page.text
    assert "the file is empty" in page.text


def test_the_page_of_a_vehicle_says_its_load_with_its_deviation(
    client: TestClient, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loaded(*given: Any) -> VehicleView:
        return replace(load_view(*given), load={"car": (-1230.4, 410.0)})

    monkeypatch.setattr("sprung.service.pages.vehicle.load_view", loaded)
    assert "Load of car: <strong>-1230 kg</strong> ± 410 kg" in client.get(f"/pages/vehicles/{broken}").text
