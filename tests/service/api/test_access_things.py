"""Jobs, reports, recordings, models and alarms that exist: another fleet's token finds, changes and deletes none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from sprung.model.system import System
from sprung.service.api.live_ingest import ingest_app
from sprung.service.api.scopes import need_of
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.diagnosis.task import IMPROVED
from sprung.service.fleet.message import MEDIA_TYPE, Message, WindowEstimate, encode
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store import schema, tokens, vehicle_models, work
from tests.service.access.test_access import bearer, routes
from tests.service.fleet.test_live_ingest import AtOnce
from tests.service.fleet.test_live_ingest import window as window_body
from tests.service_fakes import make_window

NOW = 1_790_000_000_000_000_000
TABLES = (schema.vehicles, schema.windows, schema.alarms, schema.marks, schema.jobs, schema.reports, schema.recordings)


@dataclass(frozen=True)
class Things:
    """What there is of the southern fleet."""

    job: str
    report: str
    recording: str
    alarm: int

    def path(self, template: str) -> str:
        """A route's path, of a thing that exists."""
        name = {"jobs": self.job, "reports": self.report}.get(template.split("/")[1], "south-1")
        return template.replace("{id}", name).replace("{version}", "1")


@pytest.fixture
def core(engine: Engine, system: System, data_dir: Path) -> Core:
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    for vehicle in ("north-1", "south-1"):
        core.pipeline.process(vehicle, [make_window(system, i) for i in range(2)])
    return core


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core), raise_server_exceptions=False, follow_redirects=False) as running:
        yield running


@pytest.fixture
def things(core: Core, client: TestClient) -> Things:
    """Made behind the service's back, once it runs: nothing of it is worked on."""
    file = core.settings.uploads / work.upload_name("0" * 64, "a" * 36, ".mcap")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"of the south")
    recording = work.RecordingRow("r" * 36, "south-1", "ride.mcap", "upload", file.name, 12, None, NOW, None)
    report = work.ReportRow(work.new_id(), "south-1", recording.id, "consistent", {"findings": []}, NOW)
    job = work.JobRow(work.new_id(), "recording", "queued", recording.id, "south-1", 0.0, None, None, NOW, NOW)
    folder = core.settings.reports / report.id
    folder.mkdir(parents=True)
    (folder / "report.html").write_text("<html><body>of the south</body></html>")
    (folder / IMPROVED).write_text("of the south")
    with core.store.write() as connection:
        work.add_recording(connection, recording)
        work.add_report(connection, report)
        work.add_job(connection, job)
        model = core.pipeline.engines.shared.model_id
        vehicle_models.add_version(connection, "south-1", model, "of the south", report.id, "anna", NOW)
        values = {"vehicle_id": "south-1", "model_id": model, "kind": "change", "parameter": "x", "severity": "alarm"}
        values |= {"opened_ns": NOW, "onset_ns": NOW}
        alarm = connection.execute(schema.alarms.insert().values(**values)).inserted_primary_key
    assert alarm is not None
    return Things(job.id, report.id, recording.id, int(alarm[0]))


def content(core: Core) -> dict[str, Any]:
    """Everything that is kept of vehicles, and the files."""
    with core.store.read() as connection:
        rows = {t.name: sorted(map(repr, connection.execute(select(t)).all())) for t in TABLES}
    files = [p for folder in (core.settings.uploads, core.settings.reports) for p in folder.rglob("*")]
    return rows | {"files": sorted((str(p), p.read_bytes()) for p in files if p.is_file())}


def test_who_is_refused_finds_and_changes_nothing_that_exists(client: TestClient, core: Core, things: Things) -> None:
    north, _ = core.tokens.create("north", ["admin"], fleet="north-")
    south, _ = core.tokens.create("south", ["admin"], fleet="south-")
    before, table = content(core), [(m, t) for m, t in routes(client) if "{id}" in t and "token" not in t]
    assert len(table) > 15
    for method, template in table:
        path = things.path(template)
        params = {"confirm": "south-1"} if method == "DELETE" else {}
        for token, expected in ((None, 401), ("rubbish", 401), (north, 404)):
            headers = bearer(token) if token else {}
            answer = client.request(method, path, headers=headers, params=params)
            assert answer.status_code == expected, (method, path, token, answer.text)
            assert "of the south" not in answer.text
    assert content(core) == before
    for method, template in table:
        if need_of(method, things.path(template)).scope == "read":
            status = client.get(things.path(template), headers=bearer(south)).status_code
            assert status == (422 if template.endswith("/history") else 200), template
    assert client.post(f"/jobs/{things.job}/cancel", headers=bearer(south)).json()["state"] == "failed"


def test_nothing_of_another_fleet_is_reached_from_ones_own_vehicle(
    client: TestClient, core: Core, things: Things
) -> None:
    text, _ = core.tokens.create("north", ["admin"], fleet="north-")
    before, own = content(core), "/vehicles/north-1"
    tries: list[tuple[str, str, dict[str, Any]]] = [
        ("POST", "/diagnose", {"json": {"recording": things.recording}}),
        ("POST", f"{own}/model", {"json": {"report": things.report}}),
        ("POST", f"{own}/acknowledge", {"json": {"alarm": things.alarm}}),
        ("GET", f"{own}/bundle", {"params": {"alarm": things.alarm}}),
        ("GET", f"{own}/models/1", {}),
        ("DELETE", own, {"params": {"confirm": "south-1"}}),
    ]
    for method, path, sent in tries:
        answer = client.request(method, path, headers=bearer(text), **sent)
        assert answer.status_code in (404, 422), (path, answer.text)
        assert "south" not in answer.text.replace("confirm must", "")
    for query in ({"q": "south"}, {"after": "south-0"}, {"after": ":south-0"}, {"retired": "true"}):
        answer = client.get("/vehicles", params=query, headers=bearer(text))
        assert "south-1" not in answer.text.replace("south-0", ""), (query, answer.text)
    for page in ("/", "/?q=south", "/fleet/knowledge", "/openapi.json"):
        assert "south-1" not in client.get(page, headers=bearer(text)).text
    assert content(core) == before


def test_a_file_that_another_fleet_sent_is_answered_with_ones_own_job(client: TestClient, core: Core) -> None:
    texts = {name: core.tokens.create(name, ["ingest", "read"], fleet=f"{name}-")[0] for name in ("north", "south")}
    jobs = {}
    for name, text in texts.items():
        sent = {"files": {"file": ("a.mcap", b"the same")}, "data": {"vehicle": f"{name}-1"}}
        key = {"Idempotency-Key": "the same"}
        jobs[name] = client.post("/recordings", headers=bearer(text) | key, **sent).json()  # type: ignore[arg-type]
        assert jobs[name]["vehicle"] == f"{name}-1"
    assert jobs["north"]["id"] != jobs["south"]["id"]
    for name, other in (("north", "south"), ("south", "north")):
        assert client.get(f"/jobs/{jobs[other]['id']}", headers=bearer(texts[name])).status_code == 404


def test_the_fleets_door_refuses_whoever_has_no_business_there(core: Core, system: System) -> None:
    """The same tokens at the door of the fleet variant, on all of its routes."""
    make = core.tokens.create
    (boss, _), (ended, old), (dead, gone) = (make(name, ["admin"], days=1) for name in ("boss", "ended", "dead"))
    with core.store.write() as connection:
        tokens.expire(connection, old.id, 1)
        tokens.revoke(connection, gone.id, 1)
    (north, _), (read, _) = make("n", ["ingest"], fleet="north-"), make("r", ["read"])
    south, _ = make("s", ["ingest"], fleet="south-")
    app = ingest_app(core.settings, core.store, AtOnce(core.pipeline))
    dropped = WindowEstimate(NOW, "dropped", "clipped", 0, False, None)
    message = encode(Message("south-1", core.engine.digest, (dropped,)), "small")
    bodies: dict[tuple[str, str], dict[str, Any]] = {
        ("POST", "/ingest/estimates"): {"content": message, "headers": {"content-type": MEDIA_TYPE}},
        ("POST", "/ingest/windows"): {"json": window_body(system, vehicle="south-1", start="2026-09-21T14:13:25Z")},
    }
    with TestClient(app, raise_server_exceptions=False) as client:
        table = routes(client)
        assert {route for route in table if need_of(*route).scope} - {("GET", "/openapi.json")} == set(bodies)
        before = content(core)
        for (method, path), sent in bodies.items():

            def status(token: str | None, method: str = method, path: str = path, sent: Any = sent) -> int:
                headers = sent.get("headers", {}) | (bearer(token) if token else {})
                return client.request(method, path, **sent | {"headers": headers}).status_code

            assert [status(t) for t in (None, "rubbish", boss[:-1] + "x", ended, dead)] == [401] * 5
            assert [status(t) for t in (north, read)] == [403] * 2
            assert content(core) == before
            assert status(south) == 200
            before = content(core)
