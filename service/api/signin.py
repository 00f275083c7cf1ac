"""Signing in: with a token of this service, or at the OpenID Connect provider that the settings name."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from sprung.service.access.oidc import AGAIN_SECONDS, CALLBACK, Provider, Unreachable
from sprung.service.access.tokens import SESSION_SECONDS, Refused
from sprung.service.api.access import CoreOf, note
from sprung.service.api.guard import COOKIE, session_of
from sprung.service.core import Core
from sprung.service.errors import NotFound
from sprung.service.rendering.render import render

pages = APIRouter(include_in_schema=False)
returns = APIRouter(include_in_schema=False)  # where providers send browsers back, with parameters of their own
log = logging.getLogger("sprung.signin")
STATE_COOKIE = "sprung_state"
LONGEST = 4000  # of a code or a state
INSIDE = re.compile(r"/(?![/\\])[!-\[\]-~]*")  # a path without blanks, backslashes and control characters


@pages.get("/signin")
async def sign_in_page(core: CoreOf, to: Annotated[str, Query(max_length=500)] = "/") -> HTMLResponse:
    """A form for a token, and the way to the provider where there is one."""
    needed = core.oidc is not None or await run_in_threadpool(lambda: core.tokens.any)
    return _form(core, _inside(to), needed=needed)


@pages.post("/signin")
async def sign_in(request: Request, core: CoreOf) -> Response:
    """Take a token, give a session."""
    form = await request.form(max_fields=4)
    to = _inside(str(form.get("to", "/")))
    try:
        session, actor = await run_in_threadpool(core.tokens.sign_in, str(form.get("token", "")).strip())
    except Refused as refused:
        await asyncio.sleep(0.5)  # slows down guessing
        return _form(core, to, str(refused), 401)
    await note(core, actor, "sign in", actor.name)
    response = RedirectResponse(to, 303)
    _set_session(request, response, session, SESSION_SECONDS)
    return response


@pages.get("/signin/oidc")
async def sign_in_elsewhere(
    request: Request, core: CoreOf, to: Annotated[str, Query(max_length=500)] = "/"
) -> Response:
    """Send a browser to the provider."""
    provider = _provider(core)
    callback = f"{core.settings.public_url.rstrip('/') or str(request.base_url).rstrip('/')}{CALLBACK}"
    try:
        async with provider.asking:
            place, state = await run_in_threadpool(provider.begin, callback, _inside(to))
    except Unreachable as error:
        return _unreachable(core, _inside(to), error)
    response = RedirectResponse(place, 303)
    secure = request.url.scheme == "https"  # lax: it must come along when the provider sends the browser back
    response.set_cookie(STATE_COOKIE, state, 600, path=CALLBACK, httponly=True, samesite="lax", secure=secure)
    return response


@returns.get(CALLBACK)
async def signed_in_elsewhere(request: Request, core: CoreOf) -> Response:
    """Verify the provider's answer, begin a session."""
    sent = request.query_params
    state, code = sent.get("state", "")[:LONGEST], sent.get("code", "")[:LONGEST]
    provider = _provider(core)
    try:
        begun_here = secrets.compare_digest(request.cookies.get(STATE_COOKIE, "").encode(), state.encode())
        if not state or not begun_here or sent.get("iss", provider.issuer) != provider.issuer:
            raise Refused("signing in was not begun in this browser; begin again")
        if "error" in sent or not code:
            raise Refused(f"the provider refused the sign-in: {sent.get('error', 'no code')[:200]}")
        async with provider.asking:
            actor, to = await run_in_threadpool(provider.finish, state, code)
    except Refused as refused:
        return _form(core, "/", str(refused), 401)
    except Unreachable as failed:
        return _unreachable(core, "/", failed)
    seconds = 3600 * core.settings.oidc_session_hours
    session = core.tokens.open_session(lambda: actor, seconds, actor.key)
    await note(core, actor, "sign in", actor.name)
    # a page that goes on, no redirection: browsers send the session's strict cookie with what this site begins
    response = HTMLResponse(render("onward.html", to=to))
    _set_session(request, response, session, seconds)
    response.delete_cookie(STATE_COOKIE, path=CALLBACK)
    return response


@pages.post("/signout")
async def sign_out(request: Request, core: CoreOf) -> Response:
    """End the session."""
    session = session_of(request.headers)
    actor = None if session is None else await run_in_threadpool(core.tokens.sign_out, session)
    if actor is not None:
        await note(core, actor, "sign out", actor.name)
    response = RedirectResponse("/signin", 303)
    response.delete_cookie(COOKIE)
    return response


def _form(core: Core, to: str, wrong: str = "", status: int = 200, needed: bool = True) -> HTMLResponse:
    headers = {"Retry-After": f"{AGAIN_SECONDS:.0f}"} if status == 503 else None
    page = render("signin.html", to=to, wrong=wrong, elsewhere=core.oidc is not None, needed=needed)
    return HTMLResponse(page, status, headers)


def _provider(core: Core) -> Provider:
    if core.oidc is None:
        raise NotFound("no OpenID Connect provider is set up here")
    return core.oidc


def _unreachable(core: Core, to: str, error: Unreachable) -> HTMLResponse:
    log.error("the OpenID Connect provider: %s", error)
    return _form(core, to, f"the provider cannot be reached now: {error}", 503)


def _set_session(request: Request, response: Response, session: str, seconds: float) -> None:
    secure = request.url.scheme == "https"
    response.set_cookie(COOKIE, session, max_age=int(seconds), httponly=True, samesite="strict", secure=secure)


def _inside(to: str) -> str:
    """A path of this service: not of another one, whatever browsers make of a backslash or a tab in it."""
    return to if INSIDE.fullmatch(to) else "/"
