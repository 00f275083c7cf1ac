"""Signing in at an OpenID Connect provider: a small real one, over HTTP, that misbehaves as it is told."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from fastapi.testclient import TestClient

from sprung.service.api.app import create_app
from sprung.service.api.guard import COOKIE
from sprung.service.api.signin import STATE_COOKIE
from sprung.service.core import build_core
from sprung.service.engine import Engine
from sprung.service.errors import UserError
from sprung.service.oidc import Provider
from sprung.service.settings import Settings
from sprung.service.store import audit
from sprung.service.tokens import Refused

jwt = pytest.importorskip("jwt")
ec = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ec")
KEY, STRANGER = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
GROUPS = {"works": ["operate"], "north": ["read", "ingest", "fleet:north-"], "boss": ["admin"]}


class FakeProvider(ThreadingHTTPServer):
    """Configuration, keys and the token endpoint; `claims` go into the next identity."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answers)
        self.issuer = f"http://127.0.0.1:{self.server_port}"
        self.claims: dict[str, Any] = {}
        self.codes: dict[str, dict[str, str]] = {}  # what the browser was sent with, by code
        self.key: Any = KEY
        self.asked: list[str] = []
        self.broken = False

    def token(self, **claims: Any) -> str:
        """Signed by the key of the moment."""
        usual = {"iss": self.issuer, "aud": "sprung", "sub": "7", "iat": time.time(), "exp": time.time() + 300}
        held = usual | {"preferred_username": "anna", "groups": ["works"]} | claims
        kept = {name: value for name, value in held.items() if value is not None}
        text: str = jwt.encode(kept, self.key, "ES256", headers={"kid": "one"})
        return text


class Answers(BaseHTTPRequestHandler):
    server: FakeProvider

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        if self.path == "/.well-known/openid-configuration":
            names = {"authorization_endpoint": "/authorize", "token_endpoint": "/token", "jwks_uri": "/keys"}
            self.say({"issuer": self.server.issuer} | {n: self.server.issuer + path for n, path in names.items()})
        else:
            public = json.loads(jwt.algorithms.ECAlgorithm.to_jwk(KEY.public_key()))
            self.say({"keys": [public | {"kid": "one", "use": "sig"}]})

    def do_POST(self) -> None:
        form = parse_qs(self.rfile.read(int(self.headers["content-length"])).decode())
        sent = self.server.codes.pop(form["code"][0], None)
        challenge = base64.urlsafe_b64encode(hashlib.sha256(form["code_verifier"][0].encode()).digest()).rstrip(b"=")
        if sent is None or challenge.decode() != sent["code_challenge"] or form["client_secret"] != ["hush"]:
            self.say({"error": "invalid_grant"}, 400)
        else:
            self.say({"id_token": self.server.token(**{"nonce": sent["nonce"]} | self.server.claims)})

    def say(self, thing: object, status: int = 200) -> None:
        self.send_response(500 if self.server.broken else status)
        self.end_headers()
        self.wfile.write(json.dumps(thing).encode())

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def provider() -> Iterator[FakeProvider]:
    running = FakeProvider()
    threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
    yield running
    running.shutdown()
    running.server_close()


def settings(provider: FakeProvider, folder: Path, **more: Any) -> Settings:
    secret = {"oidc_client_secret": "hush", "oidc_groups": GROUPS}
    return Settings(
        data_dir=folder,
        min_free_bytes=0,
        oidc_issuer=provider.issuer,
        oidc_client_id="sprung",
        **secret | more,  # type: ignore[arg-type]
    )


@pytest.fixture
def client(provider: FakeProvider, engine: Engine, tmp_path: Path) -> Iterator[TestClient]:
    core = build_core(settings(provider, tmp_path), engine)
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


@pytest.mark.parametrize("to", ["//evil.example", "/\\evil.example", "/\t/evil.example", "https://evil.example", "/ x"])
def test_signing_in_leads_nowhere_else(client: TestClient, provider: FakeProvider, to: str) -> None:
    sent = sent_to(client, provider, to)
    assert 'content="0;url=/"' in come_back(client, sent["state"]).text


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
    taken = Provider(settings(provider, tmp_path))
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
    taken = Provider(settings(provider, tmp_path, oidc_groups=groups, oidc_claim="realm_access.roles"))
    actor = taken.actor(provider.token(realm_access={"roles": ["south", "north", "north-works"]}))
    assert (actor.scopes, actor.fleet) == ({"read", "operate"}, "north-")


def test_a_provider_that_is_away_is_told_and_nobody_gets_in(client: TestClient, provider: FakeProvider) -> None:
    provider.broken = True
    answer = client.get("/signin/oidc")
    assert answer.status_code == 503 and "cannot be reached" in answer.text
    answer = client.get("/vehicles", headers={"authorization": f"Bearer {provider.token()}"})
    assert answer.status_code == 503 and answer.headers["retry-after"]


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
def test_settings_that_cannot_work_are_told_at_start(
    provider: FakeProvider, tmp_path: Path, wrong: dict[str, Any]
) -> None:
    given = settings(provider, tmp_path).model_dump() | {"oidc_client_secret": None} | wrong
    with pytest.raises(UserError, match=r"(?i)oidc"):
        Provider(Settings(**given))
