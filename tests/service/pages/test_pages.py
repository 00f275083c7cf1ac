"""Pages as a person's browser asks for them: those that do not exist, and lists that are longer than a page."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.model.tracking.state import Alarm
from sprung.service.api.fleet import load_view
from sprung.service.core import Core
from sprung.service.monitoring.views import VehicleView
from sprung.service.rendering.render import with_std
from sprung.service.sources.live import FeedStatus
from sprung.service.store import fleet, work
from sprung.service.store.work import JobRow
from tests.service_fakes import FakeIdentifier, make_window

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


@pytest.mark.parametrize(
    ("chi_square", "told"),
    [(1.0, "fits: the noise of the measurements explains"), (9.0, "does not fit: these errors are larger than")],
)
def test_errors_of_sensors_stand_beside_what_they_mean(
    client: TestClient, core: Core, system: System, chi_square: float, told: str
) -> None:
    """Of a vehicle that hardly moves they are large, and no fault."""
    identifier = core.engine.identifier
    assert isinstance(identifier, FakeIdentifier)
    identifier.chi_square = chi_square
    core.pipeline.process("a", [make_window(system, n) for n in range(3)])
    page = client.get("/pages/vehicles/a", headers=BROWSER).text
    assert f"The newest window {told}" in page
    assert torn_cells(page) == torn_cells(client.get("/", headers=BROWSER).text) == []
    assert "see “under model”" not in page  # which is there from the second version on


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


@pytest.mark.parametrize(("progress", "told"), [(0.0, "running"), (0.2, "running 20 %")])
def test_how_far_a_job_is_stands_there_where_it_is_known(
    client: TestClient, core: Core, progress: float, told: str
) -> None:
    """How long a recording is shows at its end."""
    with core.store.write() as connection:
        work.add_job(connection, JobRow("r", "recording", "running", None, None, progress, None, None, 1, 1))
    assert f">{told}</span>" in client.get("/pages/work").text


def test_the_page_of_work_shows_live_buses_and_what_is_wrong_with_them(client: TestClient, core: Core) -> None:
    assert "Live buses" not in client.get("/pages/work").text
    down = FeedStatus("socketcan:can0", "car-17", "down", "no such device", 0.0, 3, 2, 1, 5, 4)
    core.feeds = [SimpleNamespace(status=lambda: down)]  # type: ignore[list-item]
    shown = client.get("/pages/work").text
    for text in ("Live buses", "socketcan:can0", "no such device", "3 waiting, 3 lost", "5 frames lost"):
        assert text in shown


class _Cells(HTMLParser):
    """Cells that hold text beside elements: on a phone, where cells are flexible boxes, each would be a column."""

    def __init__(self) -> None:
        super().__init__()
        self.torn: list[str] = []
        self._open: list[str] = []
        self._text, self._elements = "", 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "td":
            self._open, self._text, self._elements = [], "", 0
        elif self._open == ["td"]:
            self._elements += 1
        if tag not in ("br", "input", "img", "meta", "link"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self._open:
            while self._open.pop() != tag:
                pass
        if tag == "td" and self._text.strip() and self._elements:
            self.torn.append(self._text)

    def handle_data(self, data: str) -> None:
        if self._open == ["td"]:
            self._text += data


def torn_cells(page: str) -> list[str]:
    """Their text."""
    cells = _Cells()
    cells.feed(page)
    return cells.torn


RECORDED = {
    "recording": "r",
    "vehicle": "tram",
    "windows": {"used": 7, "repaired": 0, "dropped": 2, "uninformative": 4},
}
REPORTED = {"report": "one", "verdict": "missing_physics"}


def test_the_page_of_work_says_what_came_of_recordings_and_diagnoses(client: TestClient, core: Core) -> None:
    ended: list[tuple[str, str, dict[str, Any] | None, str | None]] = [
        ("recording", "done", RECORDED, None),
        ("diagnosis", "done", REPORTED, None),
        ("recording", "failed", None, "the file is empty"),
    ]
    with core.store.write() as connection:
        for number, (kind, state, result, error) in enumerate(ended):
            row = work.RecordingRow(str(number), None, f"ride {number}.blf", "upload", None, 1, None, 1, None)
            work.add_recording(connection, row)
            work.add_job(connection, JobRow(str(number), kind, state, row.id, None, 1.0, result, error, number, number))
    page = client.get("/pages/work")
    assert page.status_code == 200, page.text
    assert torn_cells(page.text) == []
    assert all(f"ride {number}.blf" in page.text for number in range(3))
    assert "7 windows used, 0 repaired, 2 dropped, 4 uninformative" in page.text
    assert "7 windows used, 0 repaired, 2 dropped" in page.text and "report: missing physics" in page.text
    assert "the file is empty" in page.text


def test_the_page_of_a_vehicle_says_its_load_with_its_deviation(
    client: TestClient, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loaded(*given: Any) -> VehicleView:
        return replace(load_view(*given), load={"car": (-1230.4, 410.0)})

    monkeypatch.setattr("sprung.service.pages.vehicle.load_view", loaded)
    assert "Load of car: <strong>-1230 kg</strong> ± 410 kg" in client.get(f"/pages/vehicles/{broken}").text
