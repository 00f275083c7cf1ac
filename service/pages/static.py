"""Scripts, styles and pictures of the pages, all from here."""

from __future__ import annotations

import hashlib
import mimetypes
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from sprung.service.rendering.render import STATIC

PIECE = 1 << 16  # bytes handed to a connection at a time: it holds no more of what its client does not take


@dataclass(frozen=True, slots=True)
class Asset:
    """A file as it is answered."""

    content: bytes
    media_type: str
    etag: str


class Assets:
    """ASGI application: files that browsers keep for ever, since their addresses change with their content.

    They are held in memory, some 2 MB: read from the disk while they are sent, each piece would wait for one of the few
    threads that everything else needs, too.
    """

    def __init__(self, folder: Path) -> None:
        self._assets = {
            path.relative_to(folder).as_posix(): _read(path) for path in folder.rglob("*") if path.is_file()
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._answer(Request(scope))(scope, receive, send)

    def _answer(self, request: Request) -> Response:
        if request.method != "GET":
            raise HTTPException(405)
        path = request.scope["path"].removeprefix(request.scope.get("root_path", ""))
        asset = self._assets.get(path.lstrip("/"))
        if asset is None:
            raise HTTPException(404)
        headers = {"ETag": asset.etag}
        if request.url.query:
            headers["Cache-Control"] = "public, max-age=31536000, immutable"
        if _known(request.headers, asset.etag):
            return Response(None, 304, headers)
        headers["Content-Length"] = str(len(asset.content))
        return StreamingResponse(_pieces(asset.content), headers=headers, media_type=asset.media_type)


def assets() -> Assets:
    """The application for /static."""
    return Assets(STATIC)


def _read(path: Path) -> Asset:
    content = path.read_bytes()
    kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return Asset(content, kind, f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _known(headers: Headers, etag: str) -> bool:
    """Whether the client has it already (RFC 9110, 13.1.2)."""
    given = [tag.strip().removeprefix("W/") for tag in headers.get("if-none-match", "").split(",")]
    return etag in given or given == ["*"]


async def _pieces(content: bytes) -> AsyncIterator[memoryview]:
    whole = memoryview(content)
    for begin in range(0, len(whole), PIECE):
        yield whole[begin : begin + PIECE]
