"""Before any route: who asks, from where, how often, and whether he may; and the headers that keep browsers honest."""

from __future__ import annotations

import ipaddress
import logging
import math
import random
import re
import time
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from http.cookies import CookieError, SimpleCookie
from urllib.parse import quote, urlsplit

from cachetools import LRUCache
from prometheus_client import Histogram
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sprung.service.access.notice import is_loopback
from sprung.service.access.oidc import AGAIN_SECONDS, Provider, Unreachable, looks_like_jwt
from sprung.service.access.tokens import Actor, Refused, Tokens, digest_of
from sprung.service.api.clients import client_of
from sprung.service.api.problems import ApiProblem, problem_page, problem_response, wants_page
from sprung.service.api.scopes import ADMIN, VEHICLE_PATH, RequiredScope, content_kind, need_of, place_of
from sprung.service.observability.logs import request_id
from sprung.service.rendering.render import signed_in
from sprung.service.settings import Settings

log = logging.getLogger("sprung.requests")
COOKIE = "sprung_session"
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
HOST = re.compile(  # RFC 9110, 7.2; an IPv6 address stands in brackets
    r"(?:\[([0-9A-Fa-f:.%]*)\]|([^:\[\]/?#@\\\s\x00-\x20\x7f]*))(?::\d*)?"
)
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE")
UNSAFE = ("POST", "PUT", "PATCH", "DELETE")
BURST_SECONDS = 2.0  # of the permitted rate that may come at once
MOST_CLIENTS = 10_000
MOST_HEADERS, MOST_HEADER_BYTES = 100, 32_000  # of one request: browsers send twenty, and cookies of 4 kB at most
MOST_TARGET_BYTES = 16_000  # of path and query
SPOKEN = re.compile(r"1\.\d|[23]")  # versions of HTTP, as servers name them

LOCAL, NOBODY = Actor(), Actor("nobody", frozenset())

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
DOCS_POLICY = POLICY.replace("style-src 'self'", "style-src 'self' 'unsafe-inline'")
# a report is one self-contained page: its style and pictures are in it, and it runs nothing of another origin
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; sandbox allow-popups allow-top-navigation-by-user-activation"
)
CLOSE = {"Connection": "close"}
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


class Guard:
    """ASGI middleware, the outermost."""

    def __init__(
        self,
        app: ASGIApp,
        settings: Settings,
        tokens: Tokens,
        requests: Histogram | None = None,
        oidc: Provider | None = None,
        on_wait: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        """requests: histogram of durations; oidc: provider whose tokens are accepted as well; on_wait: called with the
        time, s, that requests wait for a thread."""
        self._on_wait = on_wait
        self.app = app
        self._oidc = oidc
        self._requests = requests
        self._settings = settings
        self._tokens = tokens
        self._limiter = Limiter(settings.client_requests_per_second)
        self._good: LRUCache[str, bool] = LRUCache(MOST_CLIENTS)  # digests of tokens and sessions that were good lately
        self._local = is_loopback(settings.host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers, started, status = Headers(scope=scope), time.perf_counter(), 0
        identity = request_id_of(headers)
        request_id.set(identity)

        async def with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                complete = MutableHeaders(scope=message)
                self._complete(scope["path"], scope, complete)
                complete["X-Request-ID"] = identity
            await send(message)

        try:
            await self._answer(scope, headers, receive, with_headers)
        finally:
            seconds = time.perf_counter() - started
            place = place_of(scope["method"], scope["path"])
            if self._requests is not None and place != "/events":
                self._requests.labels(_known(scope["method"]), place, str(status)).observe(seconds)
            log.info(
                "request",
                extra={
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "seconds": round(seconds, 4),
                },
            )

    async def _answer(self, scope: Scope, headers: Headers, receive: Receive, with_headers: Send) -> None:
        path = scope["path"]
        try:
            need = need_of(scope["method"], path)
            if not SPOKEN.fullmatch(scope.get("http_version", "1.1")):
                raise ApiProblem(505, "requests are taken in HTTP/1.1", headers=CLOSE)
            if len(scope["headers"]) > MOST_HEADERS or sum(map(_length, scope["headers"])) > MOST_HEADER_BYTES:
                raise ApiProblem(431, f"more than {MOST_HEADERS} headers, or {MOST_HEADER_BYTES // 1000} kB of them")
            if len(scope.get("raw_path") or b"") + len(scope["query_string"]) > MOST_TARGET_BYTES:
                raise ApiProblem(414, f"path and query have more than {MOST_TARGET_BYTES // 1000} kB")
            if "transfer-encoding" in headers and "content-length" in headers:  # a proxy may believe the other one
                raise ApiProblem(400, "give Content-Length or Transfer-Encoding, not both", headers=CLOSE)
            await self._check_host(headers)
            actor, by_cookie = await self._who(scope, headers, need)
            self._check_browser(scope, headers, need, by_cookie)
            self._check_scope(actor, need, path)
        except ApiProblem as problem:
            page = wants_page(scope["method"], headers)
            response = problem_page(problem, path) if page else problem_response(problem, path)
            if problem.status == 401 and page:
                response.status_code = 303
                response.headers["location"] = f"/signin?to={quote(path)}"
            await response(scope, receive, with_headers)
            return
        scope["sprung.actor"] = actor
        scope["sprung.again"] = partial(self._again, headers, need, path)
        signed_in.set(actor.name if by_cookie and actor not in (LOCAL, NOBODY) else "")
        await self.app(scope, receive, with_headers)

    @property
    def required(self) -> bool:
        """Whether requests need a token."""
        return not self._settings.open and (not self._local or self._oidc is not None or self._tokens.any)

    async def _who(self, scope: Scope, headers: Headers, need: RequiredScope) -> tuple[Actor, bool]:
        """The actor of a request, and whether a browser authenticates by itself (cookie, or no sign-in); counted.

        Requests of somebody count as his, all others as their address's, and before anything is looked up: whoever
        tries tokens runs dry.  A token that was good before does not wait for what others send from its address.
        """
        address = f"address {_address(scope)}"
        if not need.scope:  # before the store is queried, which may be at fault
            if need.limited:
                self._limiter.take(address)
            return NOBODY, True
        credential = digest_of(headers.get("authorization") or session_of(headers) or "")
        if credential not in self._good:
            self._limiter.take(address)
        try:
            found = await self._foreign(headers)
            if found is None:
                found = await run_in_threadpool(self._actor, headers, time.perf_counter())
        except ApiProblem:
            if self._good.pop(credential, False):
                self._limiter.take(address)
            raise
        actor, by_cookie = found
        if actor is LOCAL:
            return actor, by_cookie
        if not self._good.pop(credential, False):
            self._limiter.give(address)
        self._good[credential] = True
        self._limiter.take(f"token {actor.key}")
        return actor, by_cookie

    async def _again(self, headers: Headers, need: RequiredScope, path: str) -> bool:
        """Whether a request that is still being answered would be let in now: its token may have been revoked since."""
        try:
            found = await self._foreign(headers)
            if found is None:
                found = await run_in_threadpool(self._actor, headers, time.perf_counter())
            self._check_scope(found[0], need, path)
        except ApiProblem as problem:
            return problem.status >= 500  # nobody can be asked at the moment
        return True

    async def _foreign(self, headers: Headers) -> tuple[Actor, bool] | None:
        """Whose token of the provider it is; None where it is none.  Off the event loop: keys may have to be asked
        for; a few at a time, since those that wait for the provider hold threads that others need."""
        kind, _, text = headers.get("authorization", "").partition(" ")
        if self._oidc is None or kind.lower() != "bearer" or not looks_like_jwt(text.strip()):
            return None
        try:
            async with self._oidc.asking:
                return await run_in_threadpool(self._oidc.actor, text.strip()), False
        except Refused as refused:
            raise _unauthorized(str(refused)) from None
        except Unreachable as error:
            log.error("the OpenID Connect provider: %s", error)
            detail = "the provider that the token is of cannot be asked now"
            raise ApiProblem(503, detail, headers={"Retry-After": f"{AGAIN_SECONDS:.0f}"}) from None

    def _actor(self, headers: Headers, asked: float) -> tuple[Actor, bool]:
        """Whose token of this service or session it is; may read the store."""
        self._on_wait(time.perf_counter() - asked)
        given = headers.get("authorization", "")
        kind, _, text = given.partition(" ")
        try:
            if given and kind.lower() == "bearer":
                return self._tokens.actor(text.strip()), False
            if not self.required:
                return LOCAL, True
            session = session_of(headers)
            if session is not None:
                return self._tokens.session(session), True
        except Refused as refused:
            raise _unauthorized(str(refused)) from None
        raise _unauthorized("a token is needed: send `Authorization: Bearer ...`, or sign in")

    async def _check_host(self, headers: Headers) -> None:
        """Against pages whose host name was pointed at this machine: they would read everything as their own."""
        host = host_of(headers.get("host", ""))
        allowed = self._settings.allowed_hosts
        if allowed and host not in allowed:
            raise ApiProblem(421, "this host name is not served here; allow it with SPRUNG_ALLOWED_HOSTS")
        if allowed or "." not in host.rstrip(".") or host.endswith(".localhost") or _is_address(host):
            return
        if host != self._settings.host and not await run_in_threadpool(lambda: self.required):
            raise ApiProblem(421, "this host name is not served without tokens; allow it with SPRUNG_ALLOWED_HOSTS")

    def _check_browser(self, scope: Scope, headers: Headers, need: RequiredScope, by_cookie: bool) -> None:
        """Against pages of others that make a browser send: they cannot send a token, and they cannot hide."""
        if scope["method"] not in UNSAFE:
            return
        if by_cookie:
            if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
                raise ApiProblem(403, "requests of other sites are not taken")
            origin = headers.get("origin")
            if origin is not None and urlsplit(origin).netloc.lower() != headers.get("host", "").lower():
                raise ApiProblem(403, "requests of other origins are not taken")
        if need is ADMIN:  # no such route: the application says so
            return
        kind = content_kind(headers)
        length = headers.get("content-length")
        sent = "transfer-encoding" in headers or (length is not None and length != "0")
        if sent and kind not in need.body:
            raise ApiProblem(415, f"send {' or '.join(need.body)}", headers={"Accept-Post": ", ".join(need.body)})
        if headers.get("content-encoding", "identity").strip().lower() != "identity":
            raise ApiProblem(415, "send the body as it is, not compressed", headers={"Accept-Encoding": "identity"})

    def _check_scope(self, actor: Actor, need: RequiredScope, path: str) -> None:
        if need.scope and not actor.may(need.scope):
            raise ApiProblem(
                403, f"this needs the scope `{need.scope}`; the token has {', '.join(sorted(actor.scopes))}"
            )
        if need.scope and actor.fleet and not need.by_fleet:
            raise ApiProblem(403, f"this shows all vehicles; the token is for those that begin with {actor.fleet!r}")
        vehicle = VEHICLE_PATH.match(path)
        if vehicle is not None and not actor.sees(vehicle[1]):
            raise ApiProblem(404, f"nothing is known of vehicle {vehicle[1][:128]!r}")

    def _complete(self, path: str, scope: Scope, headers: MutableHeaders) -> None:
        for name, value in HEADERS.items():
            headers.setdefault(name, value)
        policy = DOCS_POLICY if path == "/docs" else REPORT_POLICY if path.endswith("/page") else POLICY
        headers.setdefault("Content-Security-Policy", policy)
        if not path.startswith("/static/"):
            headers.setdefault("Cache-Control", "no-store")
        if scope.get("scheme") == "https":
            headers.setdefault("Strict-Transport-Security", "max-age=31536000")


class Limiter:
    """A token bucket a client: `rate` requests a second, twice as many at once.  For one thread."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._most = max(1.0, BURST_SECONDS * rate)
        self._left: LRUCache[str, tuple[float, float]] = LRUCache(MOST_CLIENTS)

    def take(self, client: str) -> None:
        """Raises a 429 ApiProblem when a client asks too often."""
        now = time.monotonic()
        left, at = self._left.get(client, (self._most, now))
        left = min(self._most, left + (now - at) * self._rate)
        refused = left < 1.0
        self._left[client] = (left if refused else left - 1.0, now)
        if refused:
            wait = str(math.ceil((1.0 - left) / self._rate))
            raise ApiProblem(429, f"more than {self._rate:g} requests a second", headers={"Retry-After": wait})

    def give(self, client: str) -> None:
        """Take back the last `take`: the request was another client's."""
        if client in self._left:
            left, at = self._left[client]
            self._left[client] = (min(self._most, left + 1.0), at)


def request_id_of(headers: Mapping[str, str]) -> str:
    """The client's name for its request where it is a decent one, else a new one."""
    given = headers.get("x-request-id", "")
    return given if REQUEST_ID.fullmatch(given) else f"{random.getrandbits(64):016x}"  # no secret


def session_of(headers: Mapping[str, str]) -> str | None:
    """The session that a browser's cookie names."""
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return None
    return None if cookie is None else cookie.value


def host_of(header: str) -> str:
    """The name or address in a Host header, without its port.  Raises a 400 ApiProblem where it is something else."""
    found = HOST.fullmatch(header)
    if found is None:
        raise ApiProblem(400, "the Host header is no name or address with or without a port")
    return (found[1] or found[2] or "").lower()


@lru_cache(maxsize=100)
def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _length(header: tuple[bytes, bytes]) -> int:
    return len(header[0]) + len(header[1])


def _known(method: str) -> str:
    return method if method in METHODS else "other"


def _address(scope: Scope) -> str:
    return client_of(scope["client"][0]) if scope.get("client") else ""


def _unauthorized(detail: str) -> ApiProblem:
    return ApiProblem(401, detail, headers={"WWW-Authenticate": 'Bearer realm="sprung"'})
