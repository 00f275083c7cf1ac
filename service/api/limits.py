"""Request bodies are bounded before anything reads them."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sprung.service.api.problems import ApiProblem, problem_response


class BodyTooLarge(Exception):
    """Raised out of `receive` when a body without a stated length passes the limit."""


class BodyLimit:
    """ASGI middleware: 413 for a body longer than its path's limit, stated in its header or not."""

    def __init__(self, app: ASGIApp, limit: int, paths: Mapping[str, int]) -> None:
        self.app = app
        self.limit = limit
        self.paths = paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.paths.get(scope["path"], self.limit)
        stated = dict(scope["headers"]).get(b"content-length", b"")
        if stated.isdigit() and int(stated) > limit:
            await self._refuse(scope, receive, send, limit)
            return
        received = 0
        answered = False

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise BodyTooLarge
            return message

        async def noted(message: Message) -> None:
            nonlocal answered
            answered = True
            await send(message)

        try:
            await self.app(scope, counted, noted)
        except BodyTooLarge:
            if answered:
                raise
            await self._refuse(scope, receive, send, limit)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, limit: int) -> None:
        problem = ApiProblem(413, f"the body is longer than {limit} bytes", headers={"Connection": "close"})
        await problem_response(problem, scope["path"])(scope, receive, send)
