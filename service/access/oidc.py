"""OpenID Connect: people sign in where their organisation does, and programs send the access tokens that it gives.

The authorization code flow with PKCE, state and nonce (OpenID Connect Core 1.0, RFC 7636, RFC 9700); signatures are
checked against the provider's published keys, with asymmetric algorithms alone.  A person's rights follow from
the groups that the provider names: the settings say which group gives which scopes.  Needs the extra `oidc` (PyJWT).
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import http.client
import importlib.util
import json
import logging
import secrets
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode, urlsplit

from cachetools import TTLCache

from sprung.model.text import escaped
from sprung.service.access import outbound
from sprung.service.access.tokens import SCOPES, Actor, Refused
from sprung.service.errors import UserError
from sprung.service.settings import Settings

log = logging.getLogger("sprung.oidc")
ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
SECONDS = 5.0  # that the provider may take
MOST_BYTES = 1_000_000  # of its answers
KEPT_SECONDS = 3600.0  # for which its configuration and keys are taken as they were
AGAIN_SECONDS = 30.0  # before keys are asked for again because of a token with an unknown one, or after a failure
BEGUN_SECONDS = 600.0  # that signing in may take
MOST_BEGUN = 1000
LEEWAY = 60.0  # s, between the clocks
MOST_ASKING = 4  # requests that may wait for the provider: there are 40 threads for everything
CALLBACK = "/signin/oidc/callback"
FLEET = "fleet:"


class Unreachable(RuntimeError):
    """The provider does not answer correctly; the message is for the log and for the person who signs in."""


@dataclass(frozen=True, slots=True)
class Begun:
    """Somebody on his way to the provider."""

    nonce: str
    verifier: str
    callback: str
    to: str


@dataclass(frozen=True, slots=True)
class Grant:
    """What a group may do."""

    scopes: frozenset[str]
    fleet: str


class Provider:
    """Safe to share between threads; its calls may wait for the provider."""

    def __init__(self, settings: Settings) -> None:
        """Raises UserError for settings that cannot work."""
        if importlib.util.find_spec("jwt") is None or importlib.util.find_spec("cryptography") is None:
            raise UserError("signing in with OpenID Connect needs PyJWT; install sprung[oidc]")
        self.issuer = settings.oidc_issuer
        _check_place(self.issuer, "SPRUNG_OIDC_ISSUER")
        if not settings.oidc_client_id:
            raise UserError("setting oidc_client_id (SPRUNG_OIDC_CLIENT_ID) is missing: the provider's name for Sprung")
        self._client = settings.oidc_client_id
        self._secret = None if settings.oidc_client_secret is None else settings.oidc_client_secret.get_secret_value()
        self._audience = settings.oidc_audience or self._client
        self._claim = settings.oidc_claim
        self._grants = grants(settings.oidc_groups)
        self._begun: TTLCache[str, Begun] = TTLCache(MOST_BEGUN, BEGUN_SECONDS)
        self._configuration: tuple[float, dict[str, Any]] = (-1e9, {})
        self._keys: tuple[float, Any] = (-1e9, None)
        self._away: tuple[float, str] = (-1e9, "")  # when and how the provider failed last
        self._lock = threading.Lock()
        self.asking = asyncio.Semaphore(MOST_ASKING)  # to be held by whoever calls from an event loop

    def begin(self, callback: str, to: str) -> tuple[str, str]:
        """Where to send a browser, and the state that it must bring back.  Raises Unreachable."""
        place = self._endpoint("authorization_endpoint")
        state, nonce, verifier = (secrets.token_urlsafe(32) for _ in range(3))
        with self._lock:
            self._begun[state] = Begun(nonce, verifier, callback, to)
        challenge = base64.urlsafe_b64encode(hashlib.sha256(verifier.encode()).digest()).rstrip(b"=").decode()
        query = {
            "response_type": "code",
            "client_id": self._client,
            "redirect_uri": callback,
            "scope": "openid profile email",
            "state": state,
            "nonce": nonce,
            "code_challenge": challenge,
            "code_challenge_method": "S256",
        }
        return f"{place}{'&' if '?' in place else '?'}{urlencode(query)}", state

    def finish(self, state: str, code: str) -> tuple[Actor, str]:
        """Who came back with a code, and where he wanted to go.  Raises Refused or Unreachable."""
        with self._lock:
            begun = self._begun.pop(state, None)
        if begun is None:
            raise Refused("signing in was not begun here, or took too long; begin again")
        form = {
            "grant_type": "authorization_code",
            "code": code,
            "redirect_uri": begun.callback,
            "client_id": self._client,
            "code_verifier": begun.verifier,
        } | ({} if self._secret is None else {"client_secret": self._secret})
        answer = _fetch(self._endpoint("token_endpoint"), urlencode(form).encode())
        token = answer.get("id_token")
        if not isinstance(token, str):
            raise Refused("the provider gave no identity")
        claims = self._claims(token, self._client)
        if not secrets.compare_digest(str(claims.get("nonce", "")), begun.nonce):
            raise Refused("the provider's answer belongs to another sign-in")
        return self._actor(claims), begun.to

    def actor(self, token: str) -> Actor:
        """Whose access token (a JWT of the provider) it is.  Raises Refused or Unreachable."""
        return self._actor(self._claims(token, self._audience))

    def _actor(self, claims: Mapping[str, Any]) -> Actor:
        found: Any = claims
        for part in self._claim.split("."):
            found = found.get(part) if isinstance(found, Mapping) else None
        groups = [found] if isinstance(found, str) else found if isinstance(found, list) else []
        held = [grant for group, grant in self._grants.items() if group in groups]
        name = str(claims.get("preferred_username") or claims.get("email") or claims["sub"])[:120]
        name = escaped(name)  # often of the person's own choice, and read in the audit log
        if not held:
            raise Refused(f"{name} is in no group that may do anything here")
        # scopes of one fleet never count for another: the first group in the settings decides which fleet it is
        scopes = frozenset[str]().union(*(grant.scopes for grant in held if grant.fleet == held[0].fleet))
        return Actor(f"oidc:{name}", scopes, held[0].fleet, f"oidc:{claims['sub']}")

    def _claims(self, token: str, audience: str) -> dict[str, Any]:
        import jwt

        try:
            key = self._key(jwt.get_unverified_header(token).get("kid"))
            claims: dict[str, Any] = jwt.decode(
                token,
                key,
                algorithms=list(ALGORITHMS),
                audience=audience,
                issuer=self.issuer,
                leeway=LEEWAY,
                options={"require": ["exp", "iat", "iss", "aud", "sub"]},
            )
        except jwt.PyJWTError as error:
            raise Refused(f"the token is not good: {error}"[:200]) from None
        return claims

    def _key(self, kid: object) -> Any:
        """The provider's key of this name; keys are asked for again when it is new."""
        at, keys = self._keys
        now = time.monotonic()
        known = None if keys is None else _named(keys, kid)
        if keys is None or now - at > KEPT_SECONDS or (known is None and now - at > AGAIN_SECONDS):
            from jwt import PyJWKSet, PyJWTError

            try:
                keys = PyJWKSet.from_dict(self._published(self._endpoint("jwks_uri")))
            except PyJWTError as error:
                raise Unreachable(f"{self.issuer}: its keys cannot be used: {error}") from None
            self._keys = (now, keys)
            known = _named(keys, kid)
        if known is None:
            raise Refused("the token is signed with a key that the provider does not publish")
        return known

    def _published(self, url: str) -> dict[str, Any]:
        """What the provider says of itself.  Raises Unreachable; for a while after a failure without asking again:
        each token that anybody makes up would wait for it."""
        at, why = self._away
        if time.monotonic() - at < AGAIN_SECONDS:
            raise Unreachable(why)
        try:
            return _fetch(url)
        except Unreachable as error:
            self._away = (time.monotonic(), str(error))
            raise

    def _endpoint(self, name: str) -> str:
        at, found = self._configuration
        if time.monotonic() - at > KEPT_SECONDS:
            found = self._published(f"{self.issuer.rstrip('/')}/.well-known/openid-configuration")
            if found.get("issuer") != self.issuer:
                raise Unreachable(f"{self.issuer}: it calls itself {str(found.get('issuer'))[:200]!r}")
            self._configuration = (time.monotonic(), found)
        place = found.get(name)
        if not isinstance(place, str):
            raise Unreachable(f"{self.issuer}: its configuration has no {name}")
        try:
            _check_place(place, name)
        except UserError as error:
            raise Unreachable(f"{self.issuer}: {error}") from None
        return place


def provider_of(settings: Settings) -> Provider | None:
    """The provider of the settings; None without one.  Raises UserError."""
    return Provider(settings) if settings.oidc_issuer else None


def grants(groups: Mapping[str, list[str]]) -> dict[str, Grant]:
    """What the settings say of each group: scopes, and `fleet:PREFIX` for one fleet.  Raises UserError."""
    found = {}
    for group, words in groups.items():
        fleets = [word.removeprefix(FLEET) for word in words if word.startswith(FLEET)]
        scopes = frozenset(word for word in words if not word.startswith(FLEET))
        unknown = scopes - set(SCOPES)
        if unknown or not scopes or len(fleets) > 1:
            detail = f"{group!r}: give scopes ({', '.join(SCOPES)}) and at most one {FLEET}PREFIX"
            raise UserError(f"setting oidc_groups (SPRUNG_OIDC_GROUPS): {detail}")
        found[group] = Grant(scopes, fleets[0] if fleets else "")
    if not found:
        detail = 'say which group may do what, as in {"maintenance": ["operate"]}'
        raise UserError(f"setting oidc_groups (SPRUNG_OIDC_GROUPS): {detail}")
    return found


def looks_like_jwt(text: str) -> bool:
    """Whether a bearer token is one of a provider, rather than one that was made here."""
    return text.count(".") == 2 and text.startswith("ey")


def _named(keys: Any, kid: object) -> Any:
    """The key of this name; where the token names none and there is only one, that."""
    if kid is None:
        return keys.keys[0] if len(keys.keys) == 1 else None
    return next((key for key in keys.keys if key.key_id == kid), None)


def _check_place(url: str, what: str) -> None:
    """https, or http on this machine."""
    parts = urlsplit(url)
    local = parts.hostname in ("localhost", "127.0.0.1", "::1")
    if not parts.hostname or not (parts.scheme == "https" or (parts.scheme == "http" and local)):
        raise UserError(f"{what}: {url[:100]!r} is no https:// URL")


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


class _Timed(http.client.HTTPConnection):
    """Ended when its answer's header takes long in all: the time-out of a socket begins anew with every byte."""

    _ended: threading.Timer | None = None

    def connect(self) -> None:
        super().connect()
        self._ended = outbound.hung_up_after(self.sock, SECONDS)

    def close(self) -> None:
        if self._ended is not None:
            self._ended.cancel()
        super().close()


class _TimedTls(_Timed, http.client.HTTPSConnection):
    pass


class _Plain(urllib.request.HTTPHandler):
    def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_Timed, req)


class _Secure(urllib.request.HTTPSHandler):
    def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_TimedTls, req)


_open: Callable[..., Any] = urllib.request.build_opener(_NoRedirect, _Plain, _Secure).open


def _content(answer: Any) -> bytes:
    """As much of an answer as comes in time.  Raises TimeoutError."""
    ends, found = time.monotonic() + SECONDS, bytearray()
    while len(found) < MOST_BYTES and (piece := answer.read1(MOST_BYTES)):
        found += piece
        if time.monotonic() > ends:
            raise TimeoutError
    return bytes(found)


def _fetch(url: str, form: bytes | None = None) -> dict[str, Any]:
    """A JSON object of the provider.  Raises Unreachable, or Refused where it refuses a form."""
    host = urlsplit(url).netloc
    try:
        with _open(urllib.request.Request(url, form, {"Accept": "application/json"}), timeout=SECONDS) as answer:
            found = json.loads(_content(answer))
    except urllib.error.HTTPError as error:
        error.close()
        if form is not None and error.code in (400, 401, 403):
            log.warning("%s refused a sign-in: %d", host, error.code)
            raise Refused("the provider refused the sign-in; begin again") from None
        raise Unreachable(f"{host} answered {error.code}") from None
    except (OSError, ValueError, RuntimeError, http.client.HTTPException) as error:  # JSON too deep; no thread
        raise Unreachable(f"{host} does not answer as a provider should: {type(error).__name__}") from None
    if not isinstance(found, dict):
        raise Unreachable(f"{host} does not answer as a provider should")
    return found
