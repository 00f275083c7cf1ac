"""The fleet as a whole: what is urgent comes first, nothing alarmed is ever out of sight."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.errors import Busy, TooManyOfOne
from sprung.service.monitoring.board import Board
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.hub import Hub
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.observability.metrics import Metrics
from sprung.service.settings import Settings
from sprung.service.store import fleet, status
from sprung.service.store.schema import fleet_status
from sprung.service.times import now_ns
from tests.service_fakes import FakeIdentifier, make_window


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    return build_core(Settings(data_dir=data_dir, vehicles_in_memory=3), engine)


def feed(core: Core, system: System, vehicle: str, windows: int, level: float = 0.0, first: int = 0) -> None:
    core.pipeline.process(vehicle, [make_window(system, first + i, level) for i in range(windows)])


def alarmed(core: Core, system: System, vehicle: str) -> None:
    """A vehicle whose parameters have all grown by a third."""
    feed(core, system, vehicle, 80)
    feed(core, system, vehicle, 60, level=0.3, first=80)


def fill(core: Core, count: int) -> None:
    """Vehicles by row only, healthy but for every hundredth."""
    rng = np.random.default_rng(1)
    with core.store.write() as connection:
        for i in range(count):
            vehicle, bad = f"car-{i:04d}", i % 100 == 99
            fleet.ensure_vehicle(connection, vehicle, i)
            health = "out_of_specification" if bad else "ok"
            drift = float(rng.normal(0, 0.02)) + (-0.3 if bad else 0.0)
            found = status.Status(
                health, int(bad), 0, "secondary_1l.damping", drift, 0.01, 0.03, 1.0, "o" * 12, 10**18 + i
            )
            new = status.NewStatus(vehicle, core.pipeline.model_id, 1, found, Counter(used=5))
            status.save_statuses(connection, [new], now_ns())


def test_the_alarmed_vehicle_comes_first_on_the_page_and_in_the_api(
    client: TestClient, core: Core, system: System
) -> None:
    for vehicle in ("a", "b"):
        feed(core, system, vehicle, 3)
    alarmed(core, system, "zz-broken")
    page = client.get("/").text
    assert page.index("zz-broken") < page.index('id="v-a"') < page.index('id="v-b"')
    assert "out of specification 1" in page and "good 2" in page
    lines = client.get("/vehicles?sort=urgency&limit=1").json()
    assert [line["vehicle"] for line in lines["vehicles"]] == ["zz-broken"]
    assert lines["counts"]["out_of_specification"] == 1
    rest = client.get("/vehicles", params={"sort": "urgency", "after": lines["next"]}).json()
    assert [line["vehicle"] for line in rest["vehicles"]] == ["a", "b"]


@pytest.mark.parametrize("sort", ["urgency", "id", "last_window", "drift"])
def test_pages_by_cursor_show_every_vehicle_once(client: TestClient, core: Core, sort: str) -> None:
    fill(core, 250)
    seen: list[str] = []
    after = None
    while True:
        query = {"sort": sort, "limit": "60"} | ({} if after is None else {"after": after})
        answer = client.get("/vehicles", params=query).json()
        seen += [line["vehicle"] for line in answer["vehicles"]]
        after = answer["next"]
        if after is None:
            break
    assert sorted(seen) == [f"car-{i:04d}" for i in range(250)]
    if sort == "urgency":
        assert set(seen[:2]) == {"car-0099", "car-0199"}
    if sort == "last_window":
        assert seen[0] == "car-0249"


def test_a_cursor_that_no_page_gave_is_refused(client: TestClient) -> None:
    answer = client.get("/vehicles?sort=urgency&after=nonsense")
    assert answer.status_code == 422 and answer.json()["errors"][0]["field"] == "after"


def test_search_and_filter(client: TestClient, core: Core) -> None:
    fill(core, 120)
    assert [v["vehicle"] for v in client.get("/vehicles?q=AR-0099").json()["vehicles"]] == ["car-0099"]
    assert client.get("/vehicles?q=%25").json()["vehicles"] == []  # no wildcards
    bad = client.get("/vehicles?health=out_of_specification").json()
    assert [v["vehicle"] for v in bad["vehicles"]] == ["car-0099"] and bad["counts"]["ok"] == 119
    with core.store.write() as connection:
        old = now_ns() - 10**12
        connection.execute(fleet_status.update().where(fleet_status.c.vehicle_id == "car-0007").values(received_ns=old))
    assert [v["vehicle"] for v in client.get("/vehicles?silent=true").json()["vehicles"]] == ["car-0007"]
    assert "silent since" in client.get("/?silent=true").text
    assert "out of specification 1" in client.get("/?health=").text  # as the form sends it
    assert client.get("/?health=alarm").json()["errors"][0]["field"] == "health"


def test_two_thousand_vehicles_are_paged_quickly(client: TestClient, core: Core) -> None:
    fill(core, 2000)
    for path in ("/", "/?page=20", "/?q=car-1", "/vehicles?sort=urgency&limit=100"):
        seconds = []
        for _ in range(20):
            begin = time.process_time()  # of this process: other work on the machine does not count
            assert client.get(path).status_code == 200
            seconds.append(time.process_time() - begin)
        assert np.quantile(seconds, 0.95) < 0.5, (path, seconds)
    assert client.get("/").text.index("car-0099") < client.get("/").text.index("car-0000")
    assert "page 1 of 40" in client.get("/").text


def test_metrics_never_forget_an_alarmed_vehicle(client: TestClient, core: Core, system: System) -> None:
    alarmed(core, system, "broken")
    for i in range(6):  # more than are held in memory
        feed(core, system, f"well-{i}", 2)
    text = client.get("/metrics").text
    assert 'sprung_alarms_active{severity="alarm",vehicle="broken"} 0.0' not in text
    assert 'sprung_vehicle_health{vehicle="broken"} 2.0' in text
    assert 'sprung_vehicle_health{vehicle="well-0"}' not in text
    assert 'sprung_fleet_vehicles{health="ok"} 6.0' in text
    assert 'sprung_last_received_timestamp_seconds{vehicle="broken"}' in text
    assert "sprung_build_info{" in text


def test_series_by_parameter_go_to_alarmed_vehicles_first(engine: Engine, system: System, pipeline: Pipeline) -> None:
    board = Board(engine, 10)
    board.on_batch(pipeline.process("broken", [make_window(system, i) for i in range(80)]))
    board.on_batch(pipeline.process("broken", [make_window(system, 80 + i, 0.3) for i in range(60)]))
    board.on_batch(pipeline.process("newer", [make_window(system, i) for i in range(80)]))
    text = Metrics(board, 1).render().decode()
    assert 'sprung_parameter_ratio{element="primary_11l",quantity="stiffness",vehicle="broken"} 1.3' in text
    assert 'sprung_parameter_ratio{element="primary_11l",quantity="stiffness",vehicle="newer"}' not in text
    assert 'sprung_vehicle_largest_drift_ratio{vehicle="broken"} 0.3' in text


def test_dropped_windows_have_a_reason_in_api_and_metrics(client: TestClient, core: Core, system: System) -> None:
    core.pipeline.process("a", [make_window(system, i, outcome="dropped") for i in range(3)])
    core.pipeline.process("a", [make_window(system, 10)])
    answer = client.get("/vehicles/a").json()
    assert answer["windows"]["dropped"] == 3
    assert [(r["outcome"], r["reason"], r["windows"]) for r in answer["reasons"]] == [("dropped", "gap", 3)]
    assert 'sprung_windows_dropped_total{reason="gap",vehicle="a"} 3.0' in client.get("/metrics").text


def test_what_does_not_fit_is_reported_and_its_prior_is_no_history(
    client: TestClient, core: Core, system: System, identifier: FakeIdentifier
) -> None:
    identifier.chi_square = 5.0
    feed(core, system, "a", 20)
    answer = client.get("/vehicles/a").json()
    assert answer["windows"]["unfitting"] == 20
    assert answer["reasons"][0]["reason"] == "does not fit the model"
    assert client.get("/vehicles/a/history?parameter=primary_11l.stiffness").json()["points"] == []


def test_alarms_of_an_earlier_model_stay_in_sight(engine: Engine, data_dir: Path, system: System) -> None:
    first = build_core(Settings(data_dir=data_dir), engine)
    with TestClient(create_app(first)):
        alarmed(first, system, "a")
    bodies = {**system.file.bodies, "car": system.file.bodies["car"].model_copy(update={"roll_inertia": 6e4})}
    heavier = System(system.file.model_copy(update={"bodies": bodies}))
    other = Engine(heavier, FakeIdentifier(heavier, digest="fake-2"), engine.tracker, None)
    second = build_core(Settings(data_dir=data_dir), other)
    with TestClient(create_app(second)) as client:
        assert client.get("/vehicles").json()["vehicles"][0]["health"] == "out_of_specification"
        feed(second, system, "a", 5, first=500)
        line = client.get("/vehicles").json()["vehicles"][0]
        assert line["health"] == "maintenance_required" and line["alarms"] > 0
        assert client.get("/vehicles/a/alarms?active=true").json()["alarms"]


def test_other_weights_and_other_noises_go_on_with_the_history(engine: Engine, data_dir: Path, system: System) -> None:
    first = build_core(Settings(data_dir=data_dir), engine)
    with TestClient(create_app(first)):
        alarmed(first, system, "a")
    sensors = {name: s.model_copy(update={"noise": 2 * s.noise}) for name, s in system.file.sensors.items()}
    noisier = System(system.file.model_copy(update={"name": "renamed", "sensors": sensors}))
    assert noisier.digest != system.digest and noisier.structure == system.structure
    other = Engine(noisier, FakeIdentifier(noisier, digest="fake-2"), engine.tracker, None)
    second = build_core(Settings(data_dir=data_dir), other)
    assert second.pipeline.model_id == first.pipeline.model_id
    with TestClient(create_app(second)) as client:
        before = client.get("/vehicles/a").json()
        assert before["health"] == "out_of_specification"
        feed(second, noisier, "a", 5, first=500)
        after = client.get("/vehicles/a").json()
        assert after["windows"]["used"] == before["windows"]["used"] + 5
        assert after["parameters"][0]["baseline"] == pytest.approx(before["parameters"][0]["baseline"], rel=0.01)


def test_a_store_of_an_earlier_version_is_listed_after_the_start(
    engine: Engine, data_dir: Path, system: System
) -> None:
    first = build_core(Settings(data_dir=data_dir), engine)
    with TestClient(create_app(first)):
        alarmed(first, system, "a")
    with first.store.write() as connection:
        connection.execute(fleet_status.delete())
    with TestClient(create_app(build_core(Settings(data_dir=data_dir), engine))) as client:
        assert client.get("/vehicles").json()["vehicles"][0]["health"] == "out_of_specification"
        assert 'sprung_alarms_active{severity="alarm",vehicle="a"} 0.0' not in client.get("/metrics").text


@pytest.mark.parametrize("path", ["/vehicles?helth=alarm", "/vehicles/a?trak=true", "/health/live?x=1", "/?vehicle=a"])
def test_unknown_query_parameters_are_refused(client: TestClient, core: Core, system: System, path: str) -> None:
    feed(core, system, "a", 1)
    answer = client.get(path)
    assert answer.status_code == 422
    assert "not a query parameter" in answer.json()["detail"]


def test_several_parameters_at_once_and_as_columns(client: TestClient, core: Core, system: System) -> None:
    feed(core, system, "a", 30, level=0.1)
    query = "parameter=primary_11l.stiffness&parameter=secondary_1l.damping"
    answer = client.get(f"/vehicles/a/history?{query}").json()
    assert [h["parameter"] for h in answer["histories"]] == ["primary_11l.stiffness", "secondary_1l.damping"]
    point = answer["histories"][0]["points"][-1]
    assert point["lower95"] < point["value"] < point["upper95"]
    assert point["upper95"] - point["value"] == pytest.approx(1.96 * point["std"])
    columns = client.get(f"/vehicles/a/history?{query}&format=columns").json()
    last = columns["parameters"]["primary_11l.stiffness"]
    assert last["value"][-1] == pytest.approx(point["value"], rel=1e-5)
    assert len(columns["time"]) == len(last["std"]) == 30


def test_a_month_of_every_parameter_is_read_quickly(client: TestClient, core: Core, system: System) -> None:
    from sprung.service.store.schema import rollups
    from sprung.service.store.windows import pack

    count = len(system.parameters)
    feed(core, system, "a", 1)
    mean, std = pack(np.full(count, 0.01)), pack(np.full(count, 0.01))
    with core.store.write() as connection:
        for level in (60, 3600):
            rows = [
                {
                    "vehicle_id": "a",
                    "model_id": core.pipeline.model_id,
                    "resolution_s": level,
                    "bucket_ns": (1_780_000_000 // level * level + i * level) * 10**9,
                    "windows": 2 * level,
                    "mean": mean,
                    "std": std,
                    "low": mean,
                    "high": mean,
                    "updated_ns": 0,
                }
                for i in range(30 * 86400 // level)
            ]
            connection.execute(rollups.insert(), rows)
    query = "&".join(f"parameter={p.name}" for p in system.parameters)
    url = f"/vehicles/a/history?{query}&format=columns&until=2026-08-30T00:00:00Z"
    seconds = []
    for _ in range(5):
        begin = time.process_time()
        answer = client.get(url)
        seconds.append(time.process_time() - begin)
    assert answer.status_code == 200 and len(answer.json()["time"]) > 500
    assert np.median(seconds) < 1.0, seconds


def test_a_listener_hears_of_its_vehicle(core: Core, client: TestClient, system: System) -> None:
    woken: list[int] = []
    listener = core.hub.listen("a", lambda: woken.append(1))
    feed(core, system, "a", 2)
    feed(core, system, "b", 2)
    assert [news.vehicle for news in listener.take()] == ["a"]
    assert woken == [1]
    core.hub.leave(listener)


def test_nobody_listens_in_all_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.monitoring.hub.MOST_LISTENERS", 6)
    monkeypatch.setattr("sprung.service.monitoring.hub.MOST_OF_ONE", 4)
    hub = Hub()
    greedy = [hub.listen(None, lambda: None, "a") for _ in range(4)]
    with pytest.raises(TooManyOfOne):
        hub.listen(None, lambda: None, "a")
    others = [hub.listen(None, lambda: None, "b") for _ in range(3)]
    assert [one.ended for one in greedy + others] == [True] + 6 * [False]
    with pytest.raises(Busy):
        hub.listen(None, lambda: None, "a")


def test_a_client_that_follows_too_often_is_told_when_to_come_again(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.monitoring.hub.MOST_OF_ONE", 0)
    answer = client.get("/events")
    assert answer.status_code == 429 and answer.headers["retry-after"] == "30"
