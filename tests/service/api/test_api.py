"""The HTTP contract, with a strict identifier behind it."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.service_fakes import FakeIdentifier, hold, make_window

PROBLEM = "application/problem+json"
JSON = {"content-type": "application/json"}


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    return build_core(Settings(data_dir=data_dir, compute_queue=2, max_body_bytes=300_000), engine)


@pytest.fixture
def body(system: System) -> dict[str, Any]:
    channels = {channel.name: [0.01] * system.window for channel in system.channels}
    return {"vehicle": "demo-0001", "sample_rate": 100.0, "channels": channels}


def refused(response: Any, status: int) -> dict[str, Any]:
    """The problem of an error, checked for the form that every error has."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == PROBLEM
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    assert problem["title"] and problem["detail"]
    return problem


def test_identify_answers_as_the_contract_says(client: TestClient, body: dict[str, Any], system: System) -> None:
    answer = client.post("/identify", json=body).json()
    assert answer["vehicle"] == "demo-0001"
    assert answer["model"] == "fake-1"
    assert [p["name"] for p in answer["parameters"]] == [p.name for p in system.parameters]
    first = answer["parameters"][0]
    assert set(first) == {"name", "value", "std", "unit", "nominal", "ratio", "identifiable"}
    assert first["value"] == pytest.approx(1.22e6 * 1.01005, rel=1e-4)
    assert first["ratio"] == pytest.approx(first["value"] / first["nominal"])
    assert answer["fit"]["nrmse"] == 0.03
    assert set(answer["fit"]["per_sensor"]) == set(system.sensors)
    assert "states" not in answer


def test_identify_gives_states_only_when_asked(client: TestClient, body: dict[str, Any]) -> None:
    states = client.post("/identify?states=true", json=body).json()["states"]
    assert len(states) == 18
    assert list(states)[:3] == ["car.z", "car.roll", "car.pitch"]
    assert {len(series) for series in states.values()} == {100}


def test_identify_keeps_nothing_of_strangers(client: TestClient, body: dict[str, Any]) -> None:
    client.post("/identify", json=body)
    answer = client.get("/vehicles").json()
    assert (answer["vehicles"], answer["next"]) == ([], None)


def test_tracked_windows_are_stored_once_and_show_in_rest_and_metrics(client: TestClient, body: dict[str, Any]) -> None:
    for _ in range(2):
        answer = client.post("/identify?track=true", json=body | {"start": "2026-09-21T14:13:20Z"})
        assert answer.status_code == 200, answer.text
    assert answer.json()["posterior"][0]["ratio"] == pytest.approx(1.01, abs=1e-3)
    vehicle = client.get("/vehicles/demo-0001").json()
    assert vehicle["windows"] == {"used": 1, "repaired": 0, "dropped": 0, "uninformative": 0, "unfitting": 0}
    assert vehicle["last_window"] == "2026-09-21T14:13:20.000Z"
    assert vehicle["health"] == "ok"
    metrics = client.get("/metrics").text
    assert 'sprung_windows_total{outcome="used",vehicle="demo-0001"} 1.0' in metrics
    assert 'sprung_last_window_timestamp_seconds{vehicle="demo-0001"} 1.79e+09' in metrics


def test_tracking_without_a_start_means_a_window_that_ends_now(client: TestClient, body: dict[str, Any]) -> None:
    assert client.post("/identify?track=true", json=body).json()["tracked"] is True


def test_a_missing_sensor_is_no_error(client: TestClient, body: dict[str, Any]) -> None:
    del body["channels"]["car_1l"]
    answer = client.post("/identify", json=body)
    assert answer.status_code == 200
    assert "car_1l" not in answer.json()["fit"]["per_sensor"]


def _change(body: dict[str, Any], path: str, value: Any) -> bytes:
    """The body as JSON text with one place changed; `value` is JSON text, so that it can say what Python cannot."""
    *parents, last = path.split("/")
    target = body
    for part in parents:
        target = target[part]
    target[int(last) if isinstance(target, list) else last] = "@@"
    return json.dumps(body).replace('"@@"', value).encode()


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("channels/car_1l/5", "NaN", "channels"),
        ("channels/car_1l/5", "Infinity", "channels"),
        ("channels/car_1l/5", "-Infinity", "channels"),
        ("channels/car_1l/5", "1e400", "channels.car_1l.5"),
        ("channels/car_1l/5", '"1.5"', "channels.car_1l.5"),
        ("channels/car_1l/5", "true", "channels.car_1l.5"),
        ("channels/car_1l/5", "null", "channels.car_1l.5"),
        ("channels/car_1l/5", "[1]", "channels.car_1l.5"),
        ("channels/car_1l", "[0.0]", "channels.car_1l"),
        ("channels/car_1l", "[]", "channels.car_1l"),
        ("channels/car_1l", "7", "channels.car_1l"),
        ("channels/roof", "[0.0]", "channels.roof"),
        ("channels", "{}", "channels."),
        ("channels", "[]", "channels"),
        ("sample_rate", "50.0", "sample_rate"),
        ("sample_rate", '"100"', "sample_rate"),
        ("sample_rate", "0", "sample_rate"),
        ("vehicle", '"../etc/passwd"', "vehicle"),
        ("vehicle", "5", "vehicle"),
        ("surprise", "1", "surprise"),
    ],
)
def test_a_wrong_body_is_refused_and_the_field_named(
    client: TestClient, body: dict[str, Any], path: str, value: str, field: str
) -> None:
    response = client.post("/identify", content=_change(body, path, value), headers=JSON)
    problem = refused(response, 422)
    if value in ("NaN", "Infinity", "-Infinity"):  # no JSON at all, or not finite: either way the place is named
        assert "car_1l" in response.text or "line 1" in response.text
    else:
        assert any(error["field"].startswith(field) for error in problem["errors"]), problem


def test_a_window_without_some_inputs_is_identified_and_one_without_any_refused_by_name(
    client: TestClient, body: dict[str, Any], system: System
) -> None:
    names = [channel.name for channel in system.inputs]
    for name in names[2:]:
        del body["channels"][name]
    assert client.post("/identify", json=body).status_code == 200
    for name in names[:2]:
        del body["channels"][name]
    problem = refused(client.post("/identify", json=body), 422)
    assert problem["errors"][0]["field"] == "channels.wheel_11l.displacement"
    assert "15 like it" in problem["errors"][0]["detail"]


def test_inputs_without_any_sensor_are_refused(client: TestClient, body: dict[str, Any], system: System) -> None:
    for sensor in system.sensors:
        del body["channels"][sensor]
    refused(client.post("/identify", json=body), 422)


@pytest.mark.parametrize(
    ("key", "again"),
    [
        ("car_1l", '"car_1l": [0.0], "car_1l"'),
        ("car_1l", '"c\\u0061r_1l": [0.0], "car_1l"'),
        ("channels", '"channels": {}, "channels"'),
        ("vehicle", '"vehicle": "another", "vehicle"'),
    ],
)
def test_a_key_that_is_there_twice_is_refused(client: TestClient, body: dict[str, Any], key: str, again: str) -> None:
    content = json.dumps(body).replace(f'"{key}"', again, 1)
    problem = refused(client.post("/identify", content=content, headers=JSON), 422)
    assert {"field": key, "detail": "is there twice"} in problem["errors"]


def test_every_route_refuses_a_key_that_is_there_twice(client: TestClient, body: dict[str, Any]) -> None:
    client.post("/identify?track=true", json=body)
    post = {"content-type": "application/json"}
    twice = '{"text": "one", "text": "two"}'
    problem = refused(client.post("/vehicles/demo-0001/notes", content=twice, headers=post), 422)
    assert problem["errors"] == [{"field": "text", "detail": "is there twice"}]
    assert client.post("/vehicles/demo-0001/notes", content='{"text": "one"}', headers=post).status_code < 300


def test_names_with_escapes_are_no_repetition(client: TestClient, body: dict[str, Any]) -> None:
    content = json.dumps(body).replace("car_1l", "c\\u0061r_1l")
    assert client.post("/identify", content=content, headers=JSON).status_code == 200


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 5000])
def test_what_is_no_json_object_is_refused(client: TestClient, content: bytes) -> None:
    refused(client.post("/identify", content=content, headers=JSON), 422)


def test_a_body_past_the_limit_is_refused_stated_or_not(client: TestClient) -> None:
    refused(client.post("/identify", content=b" " * 300_001, headers=JSON), 413)

    def endless() -> Iterator[bytes]:
        for _ in range(40):
            yield b" " * 10_000

    refused(client.post("/identify", content=endless(), headers=JSON), 413)


@pytest.mark.parametrize("path", ["/vehicles/a/notes", "/tokens", "/diagnose"])
def test_a_body_that_is_held_in_memory_has_the_limit_of_those_wherever_it_is_sent(
    client: TestClient, path: str
) -> None:
    """Uploads, which `/diagnose` takes as well, may be longer because they go to the disk as they come."""

    def endless() -> Iterator[bytes]:
        for _ in range(40):
            yield b" " * 10_000

    refused(client.post(path, content=b" " * 200_000, headers=JSON), 413)
    refused(client.post(path, content=endless(), headers=JSON), 413)


def test_unknown_paths_methods_and_vehicles_are_problems(client: TestClient) -> None:
    refused(client.get("/nothing"), 404)
    refused(client.delete("/vehicles"), 405)
    for path in ("", "/history?parameter=primary_11l.stiffness", "/alarms"):
        refused(client.get(f"/vehicles/nobody{path}"), 404)
    refused(client.get("/jobs/none"), 404)
    refused(client.get("/reports/none"), 404)
    refused(client.get("/reports/none/page"), 404)


def test_a_full_queue_is_503_with_a_time_to_wait(client: TestClient, core: Core, body: dict[str, Any]) -> None:
    release, started = threading.Event(), threading.Event()
    core.compute.submit(lambda: hold(started, release))
    started.wait(5)
    for _ in range(2):
        core.compute.submit(release.wait)
    response = client.post("/identify", json=body)
    release.set()
    refused(response, 503)
    assert int(response.headers["retry-after"]) >= 1


def test_an_unexpected_error_is_a_problem_and_tells_no_secrets(
    client: TestClient, body: dict[str, Any], identifier: FakeIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the password is swordfish")

    monkeypatch.setattr(identifier, "identify", broken)
    response = client.post("/identify", json=body)
    assert "swordfish" not in json.dumps(refused(response, 500))


def feed(core: Core, system: System, windows: int, level: float = 0.0, first: int = 0) -> None:
    core.pipeline.process("demo-0001", [make_window(system, first + i, level) for i in range(windows)])


def test_history_by_parameter_range_and_resolution(client: TestClient, core: Core, system: System) -> None:
    feed(core, system, 100, level=0.1)
    url = "/vehicles/demo-0001/history?parameter=secondary_1l.damping"
    whole = client.get(url).json()
    assert (whole["unit"], whole["nominal"]) == ("N s/m", 20000.0)
    assert len(whole["points"]) == 100
    assert whole["points"][-1]["ratio"] == pytest.approx(1.105, abs=0.01)
    part = client.get(f"{url}&since=2026-09-21T14:13:30Z&until=2026-09-21T14:13:35Z").json()["points"]
    assert [p["time"] for p in part][::9] == ["2026-09-21T14:13:30.000Z", "2026-09-21T14:13:34.500Z"]
    minutes = client.get(f"{url}&resolution=1m").json()["points"]
    assert sum(p["windows"] for p in minutes) == 100
    assert {p["time"][17:] for p in minutes} == {"00.000Z"}


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("", "parameter"),
        ("parameter=wing.stiffness", "parameter"),
        ("parameter=primary_11l.stiffness&since=yesterday", "since"),
        ("parameter=primary_11l.stiffness&resolution=fast", "resolution"),
        ("parameter=primary_11l.stiffness&resolution=-5", "resolution"),
        ("parameter=primary_11l.stiffness&resolution=nan", "resolution"),
        ("parameter=primary_11l.stiffness&resolution=1e-300", "resolution"),
        ("parameter=primary_11l.stiffness&until=1e999", "until"),
    ],
)
def test_wrong_queries_name_the_field(client: TestClient, core: Core, system: System, query: str, field: str) -> None:
    feed(core, system, 2)
    problem = refused(client.get(f"/vehicles/demo-0001/history?{query}"), 422)
    assert field in problem["errors"][0]["field"]


def test_an_alarm_shows_in_rest_metrics_and_pages(client: TestClient, core: Core, system: System) -> None:
    feed(core, system, 80)
    feed(core, system, 60, level=0.3, first=80)
    alarms = client.get("/vehicles/demo-0001/alarms").json()["alarms"]
    assert alarms and all(a["severity"] == "alarm" and a["recovered"] is None for a in alarms)
    assert alarms[0]["change"] == pytest.approx(0.35, abs=0.01)
    assert client.get("/vehicles").json()["vehicles"][0]["health"] == "out_of_specification"
    assert (
        f'sprung_alarms_active{{severity="alarm",vehicle="demo-0001"}} {len(alarms)}.0' in client.get("/metrics").text
    )
    assert "out of specification" in client.get("/").text
    page = client.get("/pages/vehicles/demo-0001").text
    assert page.count('class="element"') == 12
    assert "primary_11l.stiffness" in page


def test_pages_and_docs_use_no_other_host(client: TestClient, core: Core, system: System) -> None:
    feed(core, system, 5)
    for path in ("/", "/pages/vehicles/demo-0001", "/docs"):
        response = client.get(path)
        assert response.status_code == 200
        text = response.text.replace("http://…/", "")
        assert "http://" not in text and "https://" not in text
        loaded = re.findall(r"(?:src|href)=\"([^\"]+)\"", text)
        assert all(link.startswith(("/", "?", "#")) for link in loaded), loaded


def test_docs_list_every_route(client: TestClient) -> None:
    text = client.get("/docs").text
    for path in client.get("/openapi.json").json()["paths"]:
        assert f"<code>{path}</code>" in text


def test_health_tells_ready_until_the_service_stops(client: TestClient, core: Core) -> None:
    assert client.get("/health/live").status_code == 200
    assert client.get("/health/ready").status_code == 200
    core.stopping.set()
    refused(client.get("/health/ready"), 503)
    assert client.get("/health/live").status_code == 200


def test_a_restarted_service_shows_what_it_knew(engine: Engine, data_dir: Path, system: System) -> None:
    settings = Settings(data_dir=data_dir)
    with TestClient(create_app(first := build_core(settings, engine))):
        feed(first, system, 10, level=0.1)
    with TestClient(create_app(build_core(settings, engine))) as client:
        assert client.get("/vehicles/demo-0001").json()["windows"]["used"] == 10
        assert 'sprung_last_window_timestamp_seconds{vehicle="demo-0001"}' in client.get("/metrics").text


def test_errors_that_repeat_a_path_are_never_taken_for_a_page(client: TestClient) -> None:
    response = client.get("/pages/vehicles/%3Cscript%3E")
    refused(response, 404)
    assert response.headers["x-content-type-options"] == "nosniff"
