"""Scripts, styles and pictures of the pages, all from here."""

from __future__ import annotations

from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from sprung.service.pages.render import STATIC


class Assets(StaticFiles):
    """Files that browsers keep for ever: their addresses change with their content."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """As `StaticFiles`, with how long it may be kept."""
        response = await super().get_response(path, scope)
        if scope.get("query_string"):
            response.headers["Cache-Control"] = "public, max-age=31536000, immutable"
        return response


def assets() -> Assets:
    """The application for /static."""
    return Assets(directory=STATIC)
