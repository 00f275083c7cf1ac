"""`HEAD` wherever there is `GET`: the same answer without its body."""

from __future__ import annotations

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ASKED = "sprung.head"  # in the scope of a request whose answer has no body


def headers_only(request: Request) -> bool:
    """Whether the body that a route makes would be thrown away: what takes seconds to make is then left out."""
    return bool(request.scope.get(ASKED))


class HeadAsGet:
    """ASGI middleware.  The client is reported as disconnected, which ends infinite streams."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def without_body(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        async def gone() -> Message:
            return {"type": "http.disconnect"}

        await self.app(dict(scope) | {"method": "GET", ASKED: True}, gone, without_body)
