"""Request bodies are bounded before anything reads them."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sprung.service.api.problems import ApiProblem, problem_response
from sprung.service.api.scopes import content_kind

CLOSE = {"Connection": "close"}
DISCARDED = 8_000_000  # bytes that are taken of a refused body: a connection closed on what it holds loses its answer


class BodyLimit:
    """ASGI middleware: 413 for a body longer than its limit, stated in its header or not."""

    def __init__(self, app: ASGIApp, limit: int, paths: Mapping[tuple[str, str], int]) -> None:
        """limit: bytes; paths: other ones, by path and type of body: what goes to the disk may be longer than what is
        held in memory."""
        self.app = app
        self.limit = limit
        self.paths = paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = self.paths.get((scope["path"], content_kind(headers)), self.limit)
        detail = f"the body is longer than {limit} bytes"
        stated = headers.get("content-length", "")
        if stated.isdigit() and int(stated) > limit:
            if int(stated) <= DISCARDED and "expect" not in headers:  # who asks first has not sent it
                await _discard(receive)
            await problem_response(ApiProblem(413, detail, headers=CLOSE), scope["path"])(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, detail, CLOSE)  # of any other kind, routes would make 400 without a reason
            return message

        await self.app(scope, counted, send)


async def _discard(receive: Receive) -> None:
    """Take the body without keeping it; a client that stops sending is the server's to give up."""
    while (await receive()).get("more_body", False):
        pass
