"""`/docs`: the API drawn from its own OpenAPI description, without scripts and without other hosts."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from sprung.service.pages.render import render

router = APIRouter(include_in_schema=False)


@router.get("/docs")
async def docs(request: Request) -> HTMLResponse:
    """One page with every operation, its parameters, body and answers."""
    schema = request.app.openapi()
    return HTMLResponse(render("docs.html", info=schema["info"], operations=operations(schema)))


def operations(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """Operations of an OpenAPI description in the order of its paths."""
    found = []
    for path, methods in schema["paths"].items():
        for method, operation in methods.items():
            found.append(
                {
                    "path": path,
                    "method": method.upper(),
                    "summary": operation.get("summary", ""),
                    "description": operation.get("description", ""),
                    "tag": (operation.get("tags") or [""])[0],
                    "parameters": [_parameter(p) for p in operation.get("parameters", [])],
                    "bodies": _bodies(operation, schema),
                    "answers": list(operation.get("responses", {})),
                }
            )
    return found


def _parameter(parameter: dict[str, Any]) -> dict[str, Any]:
    schema = parameter.get("schema", {})
    return {
        "name": parameter["name"],
        "where": parameter["in"],
        "required": parameter.get("required", False),
        "type": _type(schema),
        "default": schema.get("default"),
        "description": parameter.get("description", ""),
    }


def _type(schema: dict[str, Any]) -> str:
    if "anyOf" in schema:
        return " or ".join(_type(part) for part in schema["anyOf"] if part.get("type") != "null")
    return str(schema.get("type", ""))


def _bodies(operation: dict[str, Any], schema: dict[str, Any]) -> list[dict[str, str]]:
    content = operation.get("requestBody", {}).get("content", {})
    return [
        {"media_type": kind, "schema": json.dumps(_resolved(part.get("schema", {}), schema), indent=2)}
        for kind, part in content.items()
    ]


def _resolved(part: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    reference = part.get("$ref", "")
    name = reference.rsplit("/", 1)[-1]
    found: dict[str, Any] = schema.get("components", {}).get("schemas", {}).get(name, part)
    return found
