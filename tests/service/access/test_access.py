"""Access: every route with no, a wrong, an expired, a revoked, another fleet's and the right token."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pydantic import SecretStr
from sqlalchemy.exc import OperationalError

from sprung.model.system import System
from sprung.service.access.notice import access_notice, is_loopback
from sprung.service.access.tokens import Refused, Tokens
from sprung.service.api import admin
from sprung.service.api.guard import COOKIE, Limiter
from sprung.service.api.problems import ApiProblem, _as_problem
from sprung.service.api.scopes import NEEDS, need_of
from sprung.service.app import create_app
from sprung.service.cli import main
from sprung.service.core import Core, build_core
from sprung.service.errors import NotFound, UserError
from sprung.service.fleet.message import MEDIA_TYPE, Message, WindowEstimate, encode
from sprung.service.main import Feeds, serve
from sprung.service.monitoring.engine import Engine
from sprung.service.observability.logs import JsonLines, PlainLines, request_id, untold
from sprung.service.settings import Settings
from sprung.service.store import Store, audit, open_store, tokens
from tests.service_fakes import make_window

DAY = 86_400_000_000_000


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


def bearer(text: str) -> dict[str, str]:
    return {"authorization": f"Bearer {text}"}


def routes(client: TestClient) -> list[tuple[str, str]]:
    """Method and path of every route, pages among them."""
    found: list[tuple[str, str]] = []

    def walk(things: Any) -> None:
        for route in things:
            if hasattr(route, "original_router"):
                walk(route.original_router.routes)
            elif hasattr(route, "methods"):
                found.extend((method, route.path) for method in route.methods if method not in ("HEAD", "OPTIONS"))

    walk(client.app.routes)  # type: ignore[attr-defined]
    assert len(found) > 3, "the routes are not where this looks for them"
    return sorted(set(found))


def concrete(path: str) -> str:
    return path.replace("{id}", "south-1" if "vehicles" in path else "none")


def test_every_route_refuses_whoever_has_no_business_there(client: TestClient, core: Core, tmp_path: Path) -> None:
    make = core.tokens.create
    everything, _ = make("boss", ["admin"])
    nothing_of_it = {scope: make(scope, [scope])[0] for scope in ("read", "ingest", "operate", "admin")}
    revoked, dead = make("dead", ["admin"])
    ended, row = make("ended", ["admin"], days=1)
    with core.store.write() as connection:
        tokens.expire(connection, row.id, 1)
        tokens.revoke(connection, dead.id, 1)
    core.tokens._forget()
    north, _ = make("north", ["admin"], fleet="north-")
    table, asked = routes(client), 0
    for method, template in table:
        path, need = concrete(template), need_of(method, concrete(template))
        if (method, path) == ("POST", "/signin"):
            continue  # says 401 to everything but a token in its form: tried in a test of its own

        def status(token: str | None, method: str = method, path: str = path) -> int:
            nonlocal asked
            asked += 1
            short = {"seconds": "0.05"} if path == "/debug/profile" else {}
            headers = {} if token is None else bearer(token)
            return client.request(method, path, params=short, headers=headers).status_code

        if not need.scope:
            assert status(None) not in (401, 403), (method, path)
            continue
        for wrong in (None, "rubbish", everything[:-1] + "x", ended, revoked):
            assert status(wrong) == 401, (method, path, wrong)
        for scope, text in nothing_of_it.items():
            allowed = need.scope in {
                "admin": ("read", "ingest", "operate", "admin"),
                "operate": ("read", "operate"),
            }.get(scope, (scope,))
            if path == "/events" and allowed:
                continue  # an answer that never ends: tried in test_events.py
            assert (status(text) not in (401, 403)) == allowed, (method, path, scope)
        if "vehicles/{id}" in template:
            assert status(north) == 404, (method, path)
        elif not need.by_fleet:
            assert status(north) == 403, (method, path)
    print(f"{asked} requests on {len(table)} routes")  # with pytest -s; docs/reliability.md names them


def test_a_route_that_nobody_thought_of_needs_the_most() -> None:
    assert need_of("POST", "/new/thing").scope == "admin"
    assert need_of("GET", "/new/thing").scope == "read"
    assert need_of("HEAD", "/audit").scope == "admin"
    assert all(need.scope in ("", "read", "ingest", "operate", "admin") for need in NEEDS.values())


def test_a_fleets_token_sees_and_feeds_its_own_vehicles_only(client: TestClient, core: Core, system: System) -> None:
    text, _ = core.tokens.create("north", ["read", "ingest", "operate"], fleet="north-")
    own = bearer(text)
    assert [v["vehicle"] for v in client.get("/vehicles", headers=own).json()["vehicles"]] == ["north-1"]
    assert client.get("/vehicles/north-1", headers=own).status_code == 200
    assert client.get("/vehicles/south-1", headers=own).status_code == 404
    channels = {channel.name: [0.01] * system.window for channel in system.channels}
    body = {"vehicle": "south-1", "sample_rate": 100.0, "channels": channels}
    assert client.post("/identify?track=true", json=body, headers=own).status_code == 403
    assert client.post("/identify?track=true", json=body | {"vehicle": "north-2"}, headers=own).status_code == 200
    file = {"file": ("a.mcap", b"x")}
    assert client.post("/recordings", files=file, headers=own).status_code == 403
    assert client.post("/recordings", files=file, data={"vehicle": "south-1"}, headers=own).status_code == 403
    assert not list(core.settings.uploads.iterdir())
    job = client.post("/recordings", files=file, data={"vehicle": "north-1"}, headers=own).json()["id"]
    assert client.get(f"/jobs/{job}", headers=own).status_code == 200
    other, _ = core.tokens.create("south", ["read"], fleet="south-")
    assert client.get(f"/jobs/{job}", headers=bearer(other)).status_code == 404


def test_no_route_takes_another_fleets_vehicle_by_its_name(client: TestClient, core: Core, system: System) -> None:
    """Whatever is sent to: a route that is new must say here how its body names a vehicle."""
    text, _ = core.tokens.create("north", ["ingest", "operate"], fleet="north-")
    channels = {channel.name: [0.01] * system.window for channel in system.channels}
    window = {"vehicle": "south-1", "sample_rate": 100.0, "channels": channels}
    dropped = WindowEstimate(10**18, "dropped", "clipped", 0, False, None)
    message = encode(Message("south-1", core.engine.digest, (dropped,)), "small")
    upload = {"data": {"vehicle": "south-1"}, "files": {"file": ("a.mcap", b"x")}}
    bodies: dict[str, list[dict[str, Any]]] = {
        "/identify": [{"json": window}, {"json": window, "params": {"track": "true"}}],
        "/ingest/estimates": [{"content": message, "headers": {"content-type": MEDIA_TYPE}}],
        "/recordings": [upload],
        "/diagnose": [upload, {"json": {"vehicle": "south-1"}}],
    }
    with_bodies = {path for method, path in routes(client) if method != "GET" and need_of(method, path).by_fleet}
    assert {path for path in with_bodies if "{id}" not in path} == set(bodies)
    for path, tried in bodies.items():
        for sent in tried:
            answer = client.post(path, **sent | {"headers": bearer(text) | sent.get("headers", {})})
            assert answer.status_code == 403, (path, answer.text)
    assert client.get("/events?vehicle=south-1", headers=bearer(text)).status_code == 403


def test_without_any_token_only_this_machine_is_answered(engine: Engine, tmp_path: Path) -> None:
    for host, opened, expected in (("127.0.0.1", False, 200), ("0.0.0.0", False, 401), ("0.0.0.0", True, 200)):
        core = build_core(Settings(data_dir=tmp_path / host / str(opened), host=host, open=opened), engine)
        with TestClient(create_app(core)) as client:
            assert client.get("/vehicles").status_code == expected


def test_a_service_that_others_reach_does_not_start_without_a_token() -> None:
    assert "only this machine" in access_notice(Settings(host="127.0.0.1"), tokens=False)
    assert access_notice(Settings(host="0.0.0.0"), tokens=True) == ""
    assert "SPRUNG_OPEN" in access_notice(Settings(host="0.0.0.0", open=True), tokens=False)
    with pytest.raises(UserError, match="sprung token create"):
        access_notice(Settings(host="0.0.0.0"), tokens=False)
    assert [is_loopback(h) for h in ("127.0.0.1", "::1", "localhost", "127.8.8.8", "0.0.0.0", "10.0.0.1", "x.org")] == [
        True, True, True, True, False, False, False,
    ]  # fmt: skip


def test_a_service_without_a_token_is_refused_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(settings: Settings) -> Engine:
        raise LookupError("loaded")

    def start(**changes: Any) -> None:
        serve(Settings(data_dir=tmp_path, **changes), Feeds(), lambda path, core: pytest.fail(), lambda address: None)

    monkeypatch.setattr("sprung.service.main.load_engine", load)
    with pytest.raises(UserError, match="sprung token create"):
        start(host="0.0.0.0")
    for allowed in ({}, {"host": "0.0.0.0", "open": True}, {"host": "0.0.0.0", "admin_token": "x" * 20}):
        with pytest.raises(LookupError):
            start(**allowed)
    with closing(open_store(Settings(data_dir=tmp_path).store_url)) as store:
        Tokens(store).create("boss", ["admin"])
    with pytest.raises(LookupError):
        start(host="0.0.0.0")


def test_the_last_token_revoked_does_not_open_the_service(client: TestClient, core: Core) -> None:
    text, row = core.tokens.create("boss", ["admin"])
    assert client.get("/vehicles").status_code == 401
    assert client.delete(f"/tokens/{row.id}", headers=bearer(text)).status_code == 200
    assert client.get("/vehicles", headers=bearer(text)).status_code == 401
    assert client.get("/vehicles").status_code == 401


def test_the_settings_token_allows_everything(engine: Engine, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir, admin_token=SecretStr("a-very-long-secret-of-mine")), engine)
    with TestClient(create_app(core)) as client:
        assert client.get("/tokens", headers=bearer("a-very-long-secret-of-mine")).status_code == 200
        assert client.get("/tokens", headers=bearer("a-very-long-secret-of-mine2")).status_code == 401
    with pytest.raises(ValueError, match="20 characters"):
        Settings(admin_token=SecretStr("short"))


def test_no_secret_is_kept(core: Core, tmp_path: Path) -> None:
    text, _ = core.tokens.create("boss", ["admin"])
    core.close()
    secret = text.split("_", 2)[2].encode()  # which may hold an underscore itself
    assert not any(secret in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())


def test_a_token_is_rotated_and_the_old_one_ends(store: Store) -> None:
    now = time.time_ns()
    found = Tokens(store, clock=lambda: now)
    text, row = found.create("feeder", ["ingest"], fleet="a-", days=10)
    new, fresh, ends = found.rotate(row.id, hours=1)
    with store.read() as connection:
        deed = audit.entries(connection, 1)[0]
    assert (deed.action, deed.target, deed.detail and deed.detail["before"]) == ("rotate token", fresh.id, row.id)
    assert ends == now + 3600 * 10**9
    assert found.actor(text) and found.actor(new).scopes == {"ingest"}
    assert (fresh.name, fresh.fleet, fresh.expires_ns) == ("feeder", "a-", now + 10 * DAY)
    now += 2 * 3600 * 10**9
    found._forget()
    with pytest.raises(Refused, match="expired"):
        found.actor(text)
    assert found.actor(new).name == "feeder"


def test_every_token_can_be_revoked_at_once(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    """After a database was restored by its own tools: nothing in it says which tokens were revoked later."""
    tokens = Tokens(store)
    (text, row), (_, before) = tokens.create("edge", ["ingest"]), tokens.create("old", ["read"])
    tokens.revoke(before.id)
    url = str(store.engine.url)
    assert main(["token", "revoke", "--all", "--store", url]) == 0
    assert capsys.readouterr().out == f"{row.id}  edge\n"
    with pytest.raises(Refused):
        Tokens(store).actor(text)
    for wrong in ([], [row.id, "--all"]):
        assert main(["token", "revoke", *wrong, "--store", url]) == 2
        assert "or --all" in capsys.readouterr().err


def test_a_token_that_is_rotated_ends_no_later_than_it_would_have(store: Store) -> None:
    now = time.time_ns()
    found = Tokens(store, clock=lambda: now)
    _, row = found.create("feeder", ["ingest"], days=0.5)
    assert found.rotate(row.id, hours=24)[2] == row.expires_ns


def test_a_token_that_is_worth_nothing_is_not_rotated(store: Store) -> None:
    now = time.time_ns()
    found = Tokens(store, clock=lambda: now)
    (_, gone), (_, ended) = found.create("a", ["read"]), found.create("b", ["read"], days=1)
    found.revoke(gone.id)
    now += DAY
    for row, why in ((gone, "was revoked"), (ended, "has expired")):
        with pytest.raises(UserError, match=f"token {row.id}: {why}; make a new one"):
            found.rotate(row.id)
    assert len(found.rows()) == 2
    with pytest.raises(NotFound):
        found.rotate("0" * 12)


@pytest.mark.parametrize(("scopes", "days"), [([], 1), (["rule"], 1), (["read"], 0), (["read"], -1), (["read"], 1e9)])
def test_wrong_tokens_are_not_made(store: Store, scopes: list[str], days: float) -> None:
    with pytest.raises(UserError):
        Tokens(store).create("x", scopes, days=days)


def test_what_no_vehicle_is_called_is_no_fleet_and_control_characters_are_no_name(
    client: TestClient, store: Store, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for fleet in ("%", "north\x00", " north", "-north", "nörd"):
        assert client.post("/tokens", json={"name": "x", "scopes": ["read"], "fleet": fleet}).status_code == 422, fleet
        with pytest.raises(UserError, match="no vehicle's id can begin with"):
            Tokens(store).create("x", ["read"], fleet)
    with pytest.raises(UserError, match="control characters"):
        Tokens(store).create("x\x1b[31m", ["read"])
    assert Tokens(store).create("x", ["read"], "north-")[1].fleet == "north-"
    command = ["token", "create", "x", "--store", f"sqlite:///{tmp_path / 'x.db'}", "--fleet"]
    assert main([*command, ""]) == 2
    assert capsys.readouterr().err.startswith("sprung: --fleet is empty; leave it out")


def test_a_path_or_query_without_end_is_refused(client: TestClient) -> None:
    for target in ("/" + "a" * 20_000, "/vehicles?q=" + "a" * 20_000):
        answer = client.get(target)
        assert answer.status_code == 414 and len(answer.content) < 25_000


def test_people_sign_in_with_a_token_and_pages_send_them_there(client: TestClient, core: Core) -> None:
    text, row = core.tokens.create("anna", ["operate"])
    page = {"accept": "text/html"}
    answer = client.get("/", headers=page)
    assert (answer.status_code, answer.headers["location"]) == (303, "/signin?to=/")
    assert "Token" in client.get("/signin?to=/pages/work", headers=page).text
    assert client.post("/signin", data={"token": "wrong", "to": "/"}).status_code == 401
    answer = client.post("/signin", data={"token": text, "to": "/pages/work"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/pages/work")
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and text.lower() not in cookie
    assert "Sign out" in client.get("/", headers=page).text
    assert "Sign out" not in client.get("/", headers=page | bearer(text)).text  # no session: nothing to end
    client.post("/signout")
    with core.store.read() as connection:
        deeds = [(entry.actor, entry.action) for entry in audit.entries(connection, 10)]
    assert deeds[:2] == [("anna", "sign out"), ("anna", "sign in")]
    assert client.post("/signin", data={"token": text, "to": "//evil.example"}).headers["location"] == "/"
    core.tokens.revoke(row.id)
    assert client.get("/vehicles").status_code == 401
    client.post("/signout")
    assert COOKIE not in client.cookies


CROSS = [
    {"origin": "http://evil.example"},
    {"origin": "null"},
    {"sec-fetch-site": "cross-site"},
    {"sec-fetch-site": "same-site"},
]


@pytest.mark.parametrize("headers", CROSS)
def test_pages_of_others_cannot_make_a_browser_send(client: TestClient, core: Core, headers: dict[str, str]) -> None:
    assert client.post("/identify?track=true", json={}, headers=headers).status_code == 403
    assert client.post("/recordings", files={"file": ("a.mcap", b"x")}, headers=headers).status_code == 403
    text, _ = core.tokens.create("anna", ["admin"])
    client.post("/signin", data={"token": text})
    assert client.post("/identify?track=true", json={}, headers=headers).status_code == 403
    assert client.post("/identify", json={}, headers=bearer(text) | headers).status_code == 422  # no browser sends that


@pytest.mark.parametrize(
    "kind", ["", "text/plain", "application/x-www-form-urlencoded", "text/json", "multipart/form-data"]
)
def test_json_is_taken_by_its_type_only(client: TestClient, kind: str) -> None:
    response = client.post("/identify", content=b"{}", headers={"content-type": kind} if kind else {})
    assert response.status_code == 415


def test_names_that_were_pointed_here_are_not_served(client: TestClient, engine: Engine, tmp_path: Path) -> None:
    for host, expected in (
        ("attacker.example", 421),
        ("attacker.example:8000", 421),
        ("[::1]attacker.example", 400),
        ("[::1]attacker.example:8000", 400),
        ("localhost:8000attacker.example", 400),
        ("attacker.example:80:localhost", 400),
        ("[[::1]]", 400),
        ("::1", 400),
        ("attacker example", 400),
        ("local/host", 400),
        ("[attacker.example]", 400),
        ("localhost#", 400),
        ("localhost:8000", 200),
        ("127.0.0.1:8000", 200),
        ("[::1]:8000", 200),
        ("sprung:8000", 200),
    ):
        assert client.get("/vehicles", headers={"host": host}).status_code == expected, host
    core = build_core(Settings(data_dir=tmp_path / "x", allowed_hosts=("monitor.example",)), engine)
    with TestClient(create_app(core)) as other:
        assert other.get("/vehicles", headers={"host": "monitor.example"}).status_code == 200
        assert other.get("/vehicles", headers={"host": "localhost"}).status_code == 421


def test_every_answer_has_the_headers_that_keep_browsers_honest(client: TestClient) -> None:
    for path in ("/", "/docs", "/metrics", "/vehicles", "/nothing", "/signin", "/health/live"):
        headers = client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["referrer-policy"] == "same-origin"
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
        assert "script-src 'self'" in policy and "unsafe-eval" not in policy
        if path != "/docs":
            assert "unsafe-inline" not in policy
        assert "server" not in headers


def test_clients_that_ask_too_often_are_told_when_to_come_back() -> None:
    limiter = Limiter(5.0)
    for _ in range(10):
        limiter.take("a")
    with pytest.raises(ApiProblem) as caught:
        limiter.take("a")
    assert caught.value.status == 429 and int(caught.value.headers["Retry-After"]) >= 1
    limiter.take("b")


@pytest.fixture
def strict(engine: Engine, data_dir: Path) -> Core:
    """Ten requests at once, then one in ten seconds (nearly none in the time of a test)."""
    core = build_core(Settings(data_dir=data_dir, client_requests_per_second=0.1), engine)
    core.tokens.create("boss", ["admin"])
    return core


def statuses(core: Core, *asked: tuple[str, str, str]) -> list[int]:
    """Answers to requests of (address, path, token), one after the other."""
    app = create_app(core)
    found: list[int] = []
    second = TestClient(app, client=("192.0.2.2", 1))
    with TestClient(app, client=("192.0.2.1", 1)) as first:
        for address, path, token in asked:
            client = first if address == "a" else second
            found.append(client.get(path, headers=bearer(token) if token else {}).status_code)
    return found


@pytest.mark.parametrize("path", ["/signin", "/health/ready", "/static/acts.js"])
def test_who_has_no_token_is_counted_by_address(strict: Core, path: str) -> None:
    found = statuses(strict, *[("a", path, "")] * 4, ("b", path, ""), ("a", "/health/live", ""))
    assert 429 not in found[:1] and found[1:4] == [429] * 3
    assert found[4] != 429 and found[5] == 200


@pytest.mark.parametrize("token", ["", "rubbish", "sprung_0123456789ab_x", "ey.ey.ey"])
def test_who_tries_tokens_runs_dry_and_others_do_not(strict: Core, token: str, monkeypatch: pytest.MonkeyPatch) -> None:
    good = strict.tokens.create("feeder", ["read"])[0]
    looked: list[str] = []
    actor = strict.tokens.actor

    def noted(text: str) -> Any:
        looked.append(text)
        return actor(text)

    monkeypatch.setattr(strict.tokens, "actor", noted)
    found = statuses(strict, *[("a", "/vehicles", token)] * 4, ("b", "/vehicles", good))
    assert found == [401, 429, 429, 429, 200]
    assert len(looked) == 1 + bool(token)  # what is refused for coming too often is not looked up


def test_a_token_that_was_good_is_taken_beside_others_that_are_not(engine: Engine, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir, client_requests_per_second=2), engine)
    good, _ = core.tokens.create("feeder", ["read"])
    wrong = [("a", "/vehicles", f"rubbish{i}") for i in range(20)]
    found = statuses(core, ("a", "/vehicles", good), *wrong, ("a", "/vehicles", good))
    assert found[0] == found[-1] == 200 and found[-2] == 429


def test_tokens_of_the_same_name_are_counted_apart(strict: Core) -> None:
    first, _ = strict.tokens.create("feeder", ["read"])
    second, _ = strict.tokens.create("feeder", ["read"])
    found = statuses(strict, *[("a", "/vehicles", first)] * 3, ("b", "/vehicles", second))
    assert found[0] == 200 and found[2] == 429 and found[3] == 200


def test_sessions_of_others_with_the_same_name_are_not_ended(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.access.tokens.MOST_SESSIONS", 3)
    mine, greedy = (core.tokens.create("anna", ["read"])[0] for _ in range(2))
    session, _ = core.tokens.sign_in(mine)
    for _ in range(5):
        core.tokens.sign_in(greedy)
    assert core.tokens.session(session).name == "anna"


def test_deeds_are_written_down(client: TestClient, core: Core) -> None:
    text, _ = core.tokens.create("anna", ["admin"])
    job = client.post("/recordings", files={"file": ("a.mcap", b"x")}, headers=bearer(text)).json()["id"]
    client.post(f"/jobs/{job}/cancel", headers=bearer(text))
    with core.store.read() as connection:
        rows = audit.entries(connection, 10)
    assert [(row.actor, row.action) for row in rows] == [
        ("anna", "cancel job"),
        ("anna", "upload"),
        ("local", "create token"),
    ]
    answer = client.get("/audit?limit=1", headers=bearer(text)).json()
    assert (answer[0]["target"], answer[0]["actor"]) == (job, "anna")


def test_what_is_not_stored_is_not_written_down_and_the_other_way_round(
    client: TestClient, core: Core, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One transaction: a store that is locked between the two would leave a deed that nobody did."""
    before = client.get("/audit").json()

    def locked(*_: Any) -> None:
        raise OperationalError("INSERT", {}, Exception("database is locked"))

    with monkeypatch.context() as patch:
        patch.setattr("sprung.service.store.audit.record", locked)
        answer = client.post("/recordings", files={"file": ("a.mcap", b"x")})
        assert answer.status_code == 503 and answer.headers["retry-after"]
    assert client.get("/jobs").json()["jobs"] == [] and list(core.settings.uploads.iterdir()) == []
    assert client.get("/audit").json() == before


def test_a_profile_names_the_threads(client: TestClient) -> None:
    text = client.get("/debug/profile?seconds=0.1").text
    assert "sprung-compute;" in text
    with admin._profiling:  # one at a time: each holds a thread that answers requests
        answer = client.get("/debug/profile?seconds=0.1")
    assert answer.status_code == 503 and answer.headers["retry-after"] == "30"
    assert client.get("/debug/profile?seconds=0.1").status_code == 200


def test_requests_have_a_name_and_their_durations_are_counted(client: TestClient) -> None:
    assert client.get("/vehicles", headers={"x-request-id": "ride-7"}).headers["x-request-id"] == "ride-7"
    assert len(client.get("/vehicles", headers={"x-request-id": "a b\tc"}).headers["x-request-id"]) == 16
    client.get("/vehicles/north-1/alarms")
    client.get("/made/up/by/a/client")
    text = client.get("/metrics").text
    assert 'sprung_http_request_duration_seconds_count{method="GET",path="/vehicles",status="200"} 2.0' in text
    assert 'path="/vehicles/{id}/{part}"' in text and 'path="other",status="404"' in text
    assert "made" not in text and "north-1/alarms" not in text
    assert "sprung_build_info{" in text


def test_logs_are_one_json_object_a_line_with_the_request() -> None:
    record = logging.makeLogRecord({"name": "sprung.x", "levelno": 20, "levelname": "INFO", "msg": "job ended"})
    record.job = "j1"
    token = request_id.set("ride-7")
    try:
        line = json.loads(JsonLines().format(record))
    finally:
        request_id.reset(token)
    assert (line["event"], line["level"], line["job"], line["request"]) == ("job ended", "info", "j1", "ride-7")


def test_a_line_of_text_has_what_a_line_of_json_has() -> None:
    record = logging.makeLogRecord({"name": "sprung.x", "levelno": 20, "levelname": "INFO", "msg": "request"})
    record.path, record.status, record.seconds = '/a b="c"', 200, 0.12345
    token = request_id.set("ride-7")
    try:
        line = PlainLines().format(record)
    finally:
        request_id.reset(token)
    assert line == r'sprung: INFO: request request=ride-7 path="/a b=\"c\"" status=200 seconds=0.1235'


def test_an_unexpected_error_is_in_the_log_once() -> None:
    """The server reports again what the application has reported."""
    error = RuntimeError("x")
    again = logging.makeLogRecord({"name": "uvicorn.error", "msg": "x", "exc_info": (RuntimeError, error, None)})
    assert untold(again)
    assert _as_problem(error).status == 500
    assert not untold(again)


def test_a_message_of_several_lines_is_one_line_for_people() -> None:
    told = {
        "name": "sprung.x",
        "levelno": 40,
        "levelname": "ERROR",
        "msg": "%s",
        "args": ("disk is full\n[SQL: x]\nsee",),
    }
    assert PlainLines().format(logging.makeLogRecord(told)) == "sprung: ERROR: disk is full [SQL: x] see"


def test_who_signs_in_too_often_signs_out_nobody_else(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.access.tokens.MOST_SESSIONS", 20)
    greedy, other = (core.tokens.create(name, ["read"])[0] for name in ("greedy", "other"))
    mine, _ = core.tokens.sign_in(other)
    theirs = [core.tokens.sign_in(greedy)[0] for _ in range(50)]
    assert core.tokens.session(mine).name == "other"
    assert core.tokens.session(theirs[-1]).name == "greedy"
    with pytest.raises(Refused):
        core.tokens.session(theirs[0])
