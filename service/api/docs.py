"""`/docs`: the API to read and to try, from files of its own; without scripts a plain list of the operations."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from sprung.service.rendering.render import STATIC, render

router = APIRouter(include_in_schema=False)
ICON = (STATIC / "icon.svg").read_bytes()  # as a file it would be answered in ranges, and errors in plain text


@router.get("/docs")
async def docs(request: Request) -> HTMLResponse:
    """Every operation with its parameters, bodies and answers."""
    schema = request.app.openapi()
    return HTMLResponse(render("docs.html", info=schema["info"], operations=operations(schema)))


@router.get("/openapi.json")
async def openapi(request: Request) -> JSONResponse:
    """The description of the API."""
    return JSONResponse(request.app.openapi())


@router.get("/favicon.ico")
async def icon() -> Response:
    """What browsers ask for by themselves: the pages' icon."""
    return Response(ICON, media_type="image/svg+xml")


def operations(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """Operations of an OpenAPI description in the order of its paths."""
    return [
        {
            "path": path,
            "method": method.upper(),
            "summary": operation.get("summary", ""),
            "description": operation.get("description", ""),
            "tag": (operation.get("tags") or [""])[0],
            "answers": list(operation.get("responses", {})),
        }
        for path, methods in schema["paths"].items()
        for method, operation in methods.items()
    ]
