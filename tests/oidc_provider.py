"""A small real OpenID Connect provider, over HTTP, that misbehaves as it is told."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import pytest

from sprung.service.settings import Settings

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
        elif self.path.startswith("/authorize?"):  # whoever comes is let in
            sent = {name: values[0] for name, values in parse_qs(urlsplit(self.path).query).items()}
            self.server.codes["at once"] = sent
            self.send_response(303)
            back = urlencode({"state": sent["state"], "code": "at once"})
            self.send_header("location", f"{sent['redirect_uri']}?{back}")
            self.end_headers()
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


@contextmanager
def running_provider() -> Iterator[FakeProvider]:
    """One that answers."""
    running = FakeProvider()
    threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
    yield running
    running.shutdown()
    running.server_close()


def provider_settings(provider: FakeProvider, folder: Path, **more: Any) -> Settings:
    secret = {"oidc_client_secret": "hush", "oidc_groups": GROUPS}
    return Settings(
        data_dir=folder,
        min_free_bytes=0,
        oidc_issuer=provider.issuer,
        oidc_client_id="sprung",
        **secret | more,
    )
