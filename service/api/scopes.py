"""Scopes of requests, by method and path; unlisted routes need the highest."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from sprung.service.fleet.message import MEDIA_TYPE

PUBLIC = ""


@dataclass(frozen=True, slots=True)
class Need:
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
NEEDS: dict[tuple[str, str], Need] = {
    ("GET", "/health/live"): Need(PUBLIC, limited=False),
    ("GET", "/health/ready"): Need(PUBLIC),
    ("GET", "/signin"): Need(PUBLIC),
    ("POST", "/signin"): Need(PUBLIC, body=("application/x-www-form-urlencoded",)),
    ("GET", "/signin/oidc"): Need(PUBLIC),
    ("GET", "/signin/oidc/callback"): Need(PUBLIC),
    ("POST", "/signout"): Need(PUBLIC, body=("application/x-www-form-urlencoded",)),
    ("GET", "/static/{path}"): Need(PUBLIC),
    ("GET", "/favicon.ico"): Need(PUBLIC),
    ("GET", "/docs"): Need("read", by_fleet=True),
    ("GET", "/openapi.json"): Need("read", by_fleet=True),
    ("POST", "/identify"): Need("ingest", by_fleet=True),
    ("POST", "/ingest/estimates"): Need("ingest", by_fleet=True, body=(MEDIA_TYPE, "application/octet-stream")),
    ("POST", "/ingest/windows"): Need("ingest", by_fleet=True),
    ("POST", "/recordings"): Need("ingest", by_fleet=True, body=(FORM,)),
    ("POST", "/diagnose"): Need("operate", by_fleet=True, body=("application/json", FORM)),
    ("GET", "/jobs/{id}"): Need("read", by_fleet=True),
    ("POST", "/jobs/{id}/cancel"): Need("operate", by_fleet=True),
    ("GET", "/reports/{id}"): Need("read", by_fleet=True),
    ("GET", "/reports/{id}/page"): Need("read", by_fleet=True),
    ("GET", "/reports/{id}/system"): Need("read", by_fleet=True),
    ("GET", "/"): Need("read", by_fleet=True),
    ("GET", "/fleet/knowledge"): Need("read", by_fleet=True),
    ("GET", "/vehicles"): Need("read", by_fleet=True),
    ("GET", "/vehicles/{id}"): Need("read", by_fleet=True),
    ("GET", "/vehicles/{id}/{part}"): Need("read", by_fleet=True),
    ("GET", "/vehicles/{id}/models/{version}"): Need("read", by_fleet=True),
    ("GET", "/pages/vehicles/{id}"): Need("read", by_fleet=True),
    ("GET", "/pages/vehicles/{id}/standing"): Need("read", by_fleet=True),
    ("POST", "/vehicles/{id}/{deed}"): Need("operate", by_fleet=True),
    ("PATCH", "/vehicles/{id}"): Need("operate", by_fleet=True),
    ("DELETE", "/vehicles/{id}"): Need("admin", by_fleet=True),
    ("GET", "/audit"): Need("admin"),
    ("GET", "/tokens"): Need("admin"),
    ("POST", "/tokens"): Need("admin"),
    ("DELETE", "/tokens/{id}"): Need("admin"),
    ("GET", "/debug/profile"): Need("admin"),
}
OTHER = "other"
READ, ADMIN = Need("read"), Need("admin")
VEHICLE_PATH = re.compile(r"^/(?:pages/)?vehicles/([^/]+)")


def _pattern(template: str) -> re.Pattern[str]:
    inner = re.escape(template).replace(r"\{path\}", ".+")
    return re.compile("^" + re.sub(r"\\\{\w+\\\}", "[^/]+", inner) + "/?$")


_PATTERNS = [(method, _pattern(template), need, template) for (method, template), need in NEEDS.items()]


def need_of(method: str, path: str) -> Need:
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
