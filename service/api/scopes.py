"""Scopes of requests, by method and path; unlisted routes need the highest."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from sprung.service.fleet.message import MEDIA_TYPE

PUBLIC = ""


@dataclass(frozen=True, slots=True)
class RequiredScope:
    """What a request needs."""

    scope: str  # PUBLIC: nothing
    by_fleet: bool = False  # a token of one fleet may ask: the route keeps to it
    body: tuple[str, ...] = ("application/json",)  # types of body that it takes
    limited: bool = True  # how often it is asked counts


FORM = "multipart/form-data"


def content_kind(headers: Mapping[str, str]) -> str:
    """What type of body a request says it has, without parameters."""
    return headers.get("content-type", "").split(";")[0].strip().lower()


# /health/live costs nothing, and who watches the service must hear that it lives, whatever else comes from its address
NEEDS: dict[tuple[str, str], RequiredScope] = {
    ("GET", "/health/live"): RequiredScope(PUBLIC, limited=False),
    ("GET", "/health/ready"): RequiredScope(PUBLIC),
    ("GET", "/signin"): RequiredScope(PUBLIC),
    ("POST", "/signin"): RequiredScope(PUBLIC, body=("application/x-www-form-urlencoded",)),
    ("GET", "/signin/oidc"): RequiredScope(PUBLIC),
    ("GET", "/signin/oidc/callback"): RequiredScope(PUBLIC),
    ("POST", "/signout"): RequiredScope(PUBLIC, body=("application/x-www-form-urlencoded",)),
    ("GET", "/static/{path}"): RequiredScope(PUBLIC),
    ("GET", "/favicon.ico"): RequiredScope(PUBLIC),
    ("GET", "/docs"): RequiredScope("read", by_fleet=True),
    ("GET", "/openapi.json"): RequiredScope("read", by_fleet=True),
    ("POST", "/identify"): RequiredScope("ingest", by_fleet=True),
    ("POST", "/ingest/estimates"): RequiredScope(
        "ingest", by_fleet=True, body=(MEDIA_TYPE, "application/octet-stream")
    ),
    ("POST", "/ingest/windows"): RequiredScope("ingest", by_fleet=True),
    ("POST", "/recordings"): RequiredScope("ingest", by_fleet=True, body=(FORM,)),
    ("POST", "/diagnose"): RequiredScope("operate", by_fleet=True, body=("application/json", FORM)),
    ("GET", "/jobs/{id}"): RequiredScope("read", by_fleet=True),
    ("POST", "/jobs/{id}/cancel"): RequiredScope("operate", by_fleet=True),
    ("GET", "/reports/{id}"): RequiredScope("read", by_fleet=True),
    ("GET", "/reports/{id}/page"): RequiredScope("read", by_fleet=True),
    ("GET", "/reports/{id}/system"): RequiredScope("read", by_fleet=True),
    ("GET", "/"): RequiredScope("read", by_fleet=True),
    ("GET", "/fleet/knowledge"): RequiredScope("read", by_fleet=True),
    ("GET", "/vehicles"): RequiredScope("read", by_fleet=True),
    ("GET", "/vehicles/{id}"): RequiredScope("read", by_fleet=True),
    ("GET", "/vehicles/{id}/{part}"): RequiredScope("read", by_fleet=True),
    ("GET", "/vehicles/{id}/models/{version}"): RequiredScope("read", by_fleet=True),
    ("GET", "/pages/vehicles/{id}"): RequiredScope("read", by_fleet=True),
    ("GET", "/pages/vehicles/{id}/standing"): RequiredScope("read", by_fleet=True),
    ("POST", "/vehicles/{id}/{deed}"): RequiredScope("operate", by_fleet=True),
    ("PATCH", "/vehicles/{id}"): RequiredScope("operate", by_fleet=True),
    ("DELETE", "/vehicles/{id}"): RequiredScope("admin", by_fleet=True),
    ("GET", "/audit"): RequiredScope("admin"),
    ("GET", "/tokens"): RequiredScope("admin"),
    ("POST", "/tokens"): RequiredScope("admin"),
    ("DELETE", "/tokens/{id}"): RequiredScope("admin"),
    ("GET", "/debug/profile"): RequiredScope("admin"),
}
OTHER = "other"
READ, ADMIN = RequiredScope("read"), RequiredScope("admin")
VEHICLE_PATH = re.compile(r"^/(?:pages/)?vehicles/([^/]+)")


def _pattern(template: str) -> re.Pattern[str]:
    inner = re.escape(template).replace(r"\{path\}", ".+")
    return re.compile("^" + re.sub(r"\\\{\w+\\\}", "[^/]+", inner) + "/?$")


_PATTERNS = [(method, _pattern(template), need, template) for (method, template), need in NEEDS.items()]


def need_of(method: str, path: str) -> RequiredScope:
    """What a request needs; reading needs `read`, and anything else that is not listed `admin`."""
    method = "GET" if method in ("HEAD", "OPTIONS") else method
    for listed, pattern, need, _ in _PATTERNS:
        if listed == method and pattern.match(path):
            return need
    return READ if method == "GET" else ADMIN


def place_of(method: str, path: str) -> str:
    """The template of a path, for metrics: what clients make up is all one."""
    method = "GET" if method in ("HEAD", "OPTIONS") else method
    return next((text for listed, pattern, _, text in _PATTERNS if listed == method and pattern.match(path)), OTHER)
