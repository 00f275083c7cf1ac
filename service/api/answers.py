"""Answers in JSON."""

from __future__ import annotations

from fastapi.responses import Response
from pydantic import TypeAdapter

_ANY: TypeAdapter[object] = TypeAdapter(object)


def json_response(content: object, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """JSON written by pydantic's core, several times faster than the standard library's."""
    return Response(_ANY.dump_json(content), status, headers, "application/json")
