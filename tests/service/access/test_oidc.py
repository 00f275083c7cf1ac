"""Signing in at an OpenID Connect provider."""

from __future__ import annotations

import base64
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from fastapi.testclient import TestClient

from sprung.service.access.oidc import Provider, Unreachable
from sprung.service.access.tokens import Refused
from sprung.service.api.guard import COOKIE
from sprung.service.api.signin import STATE_COOKIE
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.errors import UserError
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store import audit
from tests.oidc_provider import KEY, STRANGER, FakeProvider, jwt, provider_settings, running_provider
from tests.served import served


@pytest.fixture
def provider() -> Iterator[FakeProvider]:
    with running_provider() as running:
        yield running


@pytest.fixture
def client(provider: FakeProvider, engine: Engine, data_dir: Path) -> Iterator[TestClient]:
    core = build_core(provider_settings(provider, data_dir), engine)
    with TestClient(create_app(core), raise_server_exceptions=False, follow_redirects=False) as running:
        yield running


def sent_to(client: TestClient, provider: FakeProvider, to: str = "/pages/work") -> dict[str, str]:
    """What the browser takes to the provider, which gives it the code `c`."""
    answer = client.get("/signin/oidc", params={"to": to})
    assert answer.status_code == 303 and answer.headers["location"].startswith(f"{provider.issuer}/authorize?")
    assert "samesite=lax" in answer.headers["set-cookie"].lower() and "httponly" in answer.headers["set-cookie"].lower()
    sent = {name: values[0] for name, values in parse_qs(urlsplit(answer.headers["location"]).query).items()}
    provider.codes["c"] = sent
    return sent


def come_back(client: TestClient, state: str, code: str = "c") -> Any:
    """As providers do, with parameters of their own."""
    asked = {"state": state, "code": code, "session_state": "s", "authuser": "0"}
    return client.get("/signin/oidc/callback", params=asked)


def test_people_sign_in_where_their_organisation_does(client: TestClient, provider: FakeProvider) -> None:
    page = {"accept": "text/html"}
    assert client.get("/", headers=page).headers["location"] == "/signin?to=/"  # a provider is enough to ask
    assert "Sign in with your organisation" in client.get("/signin").text
    sent = sent_to(client, provider)
    assert sent["redirect_uri"] == "http://testserver/signin/oidc/callback" and sent["code_challenge_method"] == "S256"
    answer = come_back(client, sent["state"])
    assert answer.status_code == 200 and 'content="0;url=/pages/work"' in answer.text
    cookie = next(c for c in answer.headers.get_list("set-cookie") if c.startswith(COOKIE)).lower()
    assert "httponly" in cookie and "samesite=strict" in cookie
    assert client.get("/", headers=page).status_code == 200
    assert client.get("/tokens").status_code == 403  # `operate` is no `admin`
    core = client.app.state.core  # type: ignore[attr-defined]
    with core.store.read() as connection:
        deed = audit.entries(connection, 1)[0]
    assert (deed.actor, deed.action) == ("oidc:anna", "sign in")
    assert come_back(client, sent["state"]).status_code == 401  # a second time
    client.post("/signout")
    assert client.get("/vehicles").status_code == 401


@pytest.mark.parametrize("to", ["//evil.example", "/\\evil.example", "https://evil.example", "/ x"])
def test_signing_in_leads_nowhere_else(client: TestClient, provider: FakeProvider, to: str) -> None:
    sent = sent_to(client, provider, to)
    assert 'content="0;url=/"' in come_back(client, sent["state"]).text


def test_an_address_with_control_characters_is_refused(client: TestClient, provider: FakeProvider) -> None:
    answer = client.get("/signin/oidc", params={"to": "/\t/evil.example"})
    assert answer.status_code == 422


@pytest.mark.parametrize(
    ("claims", "told"),
    [
        ({"nonce": "other"}, "belongs to another sign-in"),
        ({"aud": "another"}, "not good"),
        ({"iss": "https://evil.example"}, "not good"),
        ({"exp": 1000}, "not good"),
        ({"exp": None}, "not good"),
        ({"sub": None}, "not good"),
        ({"iat": 4e9}, "not good"),
        ({"groups": ["guests"]}, "in no group"),
        ({"groups": None}, "in no group"),
        ({"groups": {"works": 1}}, "in no group"),
    ],
)
def test_a_wrong_identity_is_none(
    client: TestClient, provider: FakeProvider, claims: dict[str, Any], told: str
) -> None:
    provider.claims = claims
    answer = come_back(client, sent_to(client, provider)["state"])
    assert answer.status_code == 401 and told in answer.text
    assert client.get("/vehicles").status_code == 401


def test_only_the_browser_that_began_comes_back(client: TestClient, provider: FakeProvider) -> None:
    state = sent_to(client, provider)["state"]
    for wrong in ("", "x", state[:-1]):
        assert come_back(client, wrong).status_code == 401
    client.cookies.delete(STATE_COOKIE, path="/signin/oidc/callback")
    assert come_back(client, state).status_code == 401
    state = sent_to(client, provider)["state"]
    assert come_back(client, state, "guessed").status_code == 401
    assert client.get("/signin/oidc/callback", params={"state": state, "error": "denied"}).status_code == 401


def test_forged_signatures_are_refused(provider: FakeProvider, tmp_path: Path) -> None:
    taken = Provider(provider_settings(provider, tmp_path))
    good = provider.token()
    assert taken.actor(good).name == "oidc:anna"
    claims = jwt.decode(good, options={"verify_signature": False})
    provider.key = STRANGER
    head, body, _ = good.split(".")
    unsigned = base64.urlsafe_b64encode(b'{"alg":"none","kid":"one"}').rstrip(b"=").decode()
    public = json.dumps(jwt.algorithms.ECAlgorithm.to_jwk(KEY.public_key())).encode()
    symmetric = jwt.encode(claims, public, "HS256", headers={"kid": "one"})
    other = jwt.encode(claims, KEY, "ES256", headers={"kid": "two"})
    for forged in (provider.token(), f"{unsigned}.{body}.", f"{head}.{body}.AAAA", symmetric, other, "ey.ey.ey"):
        with pytest.raises(Refused):
            taken.actor(forged)
    assert provider.asked.count("/keys") == 1  # strangers' key names do not make it ask again and again


def test_programs_send_the_access_tokens_of_the_provider(client: TestClient, provider: FakeProvider) -> None:
    def status(path: str, **claims: Any) -> int:
        return int(client.get(path, headers={"authorization": f"Bearer {provider.token(**claims)}"}).status_code)

    assert status("/vehicles") == 200
    assert status("/vehicles", exp=1000) == 401
    assert status("/tokens") == 403
    assert status("/tokens", groups=["boss"]) == 200
    assert status("/metrics", groups=["north"]) == 403  # shows all vehicles
    assert status("/vehicles/south-1", groups=["north"]) == 404
    assert status("/metrics", groups=["north", "works"]) == 200
    assert client.get("/vehicles", headers={"authorization": "Bearer sprung_abc_def"}).status_code == 401


def test_scopes_of_one_fleet_never_count_for_another(provider: FakeProvider, tmp_path: Path) -> None:
    groups = {
        "north": ["read", "fleet:north-"],
        "south": ["admin", "fleet:south-"],
        "north-works": ["operate", "fleet:north-"],
    }
    taken = Provider(provider_settings(provider, tmp_path, oidc_groups=groups, oidc_claim="realm_access.roles"))
    actor = taken.actor(provider.token(realm_access={"roles": ["south", "north", "north-works"]}))
    assert (set(actor.scopes), actor.fleet) == ({"read", "operate"}, "north-")


def test_a_provider_that_is_away_is_reported_and_nobody_gets_in(client: TestClient, provider: FakeProvider) -> None:
    provider.broken = True
    answer = client.get("/signin/oidc")
    assert answer.status_code == 503 and "cannot be reached" in answer.text and answer.headers["retry-after"]
    answer = client.get("/vehicles", headers={"authorization": f"Bearer {provider.token()}"})
    assert answer.status_code == 503 and answer.headers["retry-after"]
    assert len(provider.asked) == 1  # who makes up tokens does not wait for it each time, and holds nobody up


def test_a_provider_that_is_back_is_asked_again(
    client: TestClient, provider: FakeProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    headers = {"authorization": f"Bearer {provider.token()}"}
    provider.broken = True
    assert client.get("/vehicles", headers=headers).status_code == 503
    provider.broken = False
    assert client.get("/vehicles", headers=headers).status_code == 503
    monkeypatch.setattr("sprung.service.access.oidc.AGAIN_SECONDS", 0.0)
    assert client.get("/vehicles", headers=headers).status_code == 200


def test_sign_ins_that_wait_for_a_provider_hold_up_nobody_else(
    engine: Engine, data_dir: Path, provider: FakeProvider
) -> None:
    """It takes connections and never answers; more people sign in than the service has threads."""
    with socket.create_server(("127.0.0.1", 0), backlog=200) as silent:
        provider.issuer = f"http://127.0.0.1:{silent.getsockname()[1]}"
        core = build_core(provider_settings(provider, data_dir), engine)
        token = core.tokens.create("t", ["read"])[0]
        with served(core) as port:

            def status(path: str, **headers: str) -> int:
                with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
                    connection.request("GET", path, headers=headers)
                    return connection.getresponse().status

            people = [threading.Thread(target=status, args=("/signin/oidc",), daemon=True) for _ in range(80)]
            for one in people:
                one.start()
            time.sleep(0.5)
            begun = time.monotonic()
            assert status("/vehicles", authorization=f"Bearer {token}") == 200
            assert time.monotonic() - begun < 4.5  # the provider's five seconds are not over
            for one in people:
                one.join()


@pytest.mark.parametrize("begins", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\nContent-Length: 9999\r\n\r\n{"])
def test_a_provider_that_drips_is_hung_up_on(
    provider: FakeProvider, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begins: bytes
) -> None:
    """Each byte comes in time, of the header or of the body; all of them together do not."""
    monkeypatch.setattr("sprung.service.access.oidc.SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            line, _ = listening.accept()
            with line, suppress(OSError):
                line.recv(65536)
                line.sendall(begins)
                for _ in range(100):
                    line.sendall(b" ")
                    time.sleep(0.1)

        dripping = threading.Thread(target=drip, daemon=True)
        dripping.start()
        provider.issuer = f"http://127.0.0.1:{listening.getsockname()[1]}"
        begun = time.monotonic()
        with pytest.raises(Unreachable):
            Provider(provider_settings(provider, tmp_path)).begin("http://x/", "/")
        assert time.monotonic() - begun < 5.0
        dripping.join()


def test_people_who_choose_the_same_name_are_counted_apart(provider: FakeProvider, tmp_path: Path) -> None:
    taken = Provider(provider_settings(provider, tmp_path))
    one, other = (taken.actor(provider.token(sub=sub, preferred_username="anna")) for sub in ("7", "8"))
    assert one.name == other.name and one.key != other.key


def test_names_that_people_choose_cannot_deceive(provider: FakeProvider, tmp_path: Path) -> None:
    taken = Provider(provider_settings(provider, tmp_path))
    name = taken.actor(provider.token(preferred_username="anna\x1b[31m\u202e\n2026 admin")).name
    assert name == r"oidc:anna\x1b[31m\u202e\n2026 admin"


@pytest.mark.parametrize(
    "wrong",
    [
        {"oidc_issuer": "http://login.example.org"},
        {"oidc_issuer": "login"},
        {"oidc_client_id": ""},
        {"oidc_groups": {}},
        {"oidc_groups": {"a": []}},
        {"oidc_groups": {"a": ["root"]}},
        {"oidc_groups": {"a": ["read", "fleet:a", "fleet:b"]}},
    ],
)
def test_settings_that_cannot_work_are_reported_at_start(
    provider: FakeProvider, tmp_path: Path, wrong: dict[str, Any]
) -> None:
    given = provider_settings(provider, tmp_path).model_dump() | {"oidc_client_secret": None} | wrong
    with pytest.raises(UserError, match=r"(?i)oidc"):
        Provider(Settings(**given))
