"""The OpenAPI description: every error as problem+json, examples, and no answer without a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from sprung.service.api.models import ProblemAnswer

KEPT_EXAMPLES = Path(__file__).parent / "examples.json"  # answers of a real service, shortened
MEDIA = "application/problem+json"
ERRORS = {
    404: ("Not Found", "No such thing.", "nothing is known of vehicle 'car-99'"),
    413: ("Content Too Large", "The body is past the limit.", "the body is longer than 2000000 bytes"),
    421: ("Misdirected Request", "The host name is not served here.", "this host name is not served here"),
    415: ("Unsupported Media Type", "Another kind of body is needed.", "send multipart/form-data or JSON"),
    400: ("Bad Request", "What came is no HTTP that can be understood.", "invalid request"),
    401: ("Unauthorized", "A token is needed, or the one that was sent is wrong or expired.", "a token is needed"),
    403: ("Forbidden", "The token does not allow this.", "the token has no scope `operate`"),
    409: ("Conflict", "A request with this Idempotency-Key is being worked on, or was another one.", "it is at work"),
    405: ("Method Not Allowed", "The path takes other methods.", "Method Not Allowed"),
    429: ("Too Many Requests", "More than the limit of one client; `Retry-After` says when.", "too many requests"),
    414: ("URI Too Long", "A path and query longer than any client needs.", "path and query have more than 16 kB"),
    431: ("Request Header Fields Too Large", "More headers than any client needs.", "more than 100 headers"),
    507: ("Insufficient Storage", "No room is left for uploads or on the disk.", "no room for this upload"),
    422: ("Unprocessable Content", "The body or the query is wrong; the fields are named.", "parameter: is needed"),
    503: ("Service Unavailable", "A queue is full, or the service stops; `Retry-After` says when.", "try again"),
}


def _problem(status: int) -> dict[str, Any]:
    title, text, detail = ERRORS[status]
    example = {"type": "about:blank", "title": title, "status": status, "detail": detail, "instance": "/vehicles"}
    schema = {"$ref": "#/components/schemas/ProblemAnswer"}
    return {"description": text, "content": {MEDIA: {"schema": schema, "example": example}}}


PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: _problem(status) for status in (401, 403, 414, 415, 421, 422, 429, 431, 503)
}


def describe(app: FastAPI) -> None:
    """Give the application an `openapi` that is made once."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            found = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            schemas = found.setdefault("components", {}).setdefault("schemas", {})
            own = ProblemAnswer.model_json_schema(ref_template="#/components/schemas/{model}")
            kept = json.loads(KEPT_EXAMPLES.read_text(encoding="utf-8"))
            schemas |= own.pop("$defs", {}) | {"ProblemAnswer": own}
            for path, methods in found["paths"].items():
                for method, operation in methods.items():
                    _complete(path, operation)
                    example = EXAMPLES.get((path, method)) or kept.get(f"{method} {path}")
                    if example is not None:
                        _answer(operation)["example"] = example
            app.openapi_schema = found
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # as FastAPI documents it


def _answer(operation: dict[str, Any]) -> dict[str, Any]:
    """The content of the answer of a request that went well."""
    status = next(status for status in sorted(operation["responses"]) if status.startswith("2"))
    content: dict[str, Any] = operation["responses"][status]["content"]["application/json"]
    return content


EXAMPLES: dict[tuple[str, str], Any] = {
    ("/vehicles", "get"): {
        "vehicles": [
            {
                "vehicle": "car-17",
                "label": None,
                "health": "out_of_specification",
                "last_window": "2026-09-21T14:23:19.500Z",
                "received": "2026-09-21T14:23:20.112Z",
                "silent": False,
                "alarms": 1,
                "unacknowledged": 1,
                "largest": "secondary_2l.damping",
                "drift": -0.392,
                "learned": 1.0,
                "retired": None,
            }
        ],
        "next": None,
        "counts": {"ok": 41, "out_of_specification": 1},
    },
    ("/vehicles/{id}/history", "get"): {
        "vehicle": "car-17",
        "parameter": "secondary_2l.damping",
        "unit": "N s/m",
        "nominal": 20000.0,
        "resolution": 60.0,
        "points": [
            {
                "time": "2026-09-21T14:23:00.000Z",
                "value": 11160.0,
                "std": 37.7,
                "lower95": 11086.1,
                "upper95": 11233.9,
                "low": 11120.0,
                "high": 11210.0,
                "ratio": 0.558,
                "windows": 120,
            }
        ],
    },
    ("/vehicles/{id}/alarms", "get"): {
        "vehicle": "car-17",
        "alarms": [
            {
                "id": 7,
                "vehicle": "car-17",
                "parameter": "secondary_2l.damping",
                "kind": "change",
                "onset": "2026-09-21T14:13:50.000Z",
                "raised": "2026-09-21T14:14:02.000Z",
                "recovered": None,
                "change": -0.392,
                "std": 0.002,
                "severity": "alarm",
                "report": None,
                "acknowledged": None,
                "acknowledged_by": None,
                "bundle": "/vehicles/car-17/bundle?alarm=7",
            }
        ],
    },
}


def _complete(path: str, operation: dict[str, Any]) -> None:
    answers = operation["responses"]
    if "{" in path or path == "/diagnose":
        answers.setdefault("404", _problem(404))
    if any(one.get("name") == "Idempotency-Key" for one in operation.get("parameters", [])):
        answers.setdefault("409", _problem(409))
    if "requestBody" in operation:
        answers.setdefault("400", _problem(400))
        answers.setdefault("413", _problem(413))
        answers.setdefault("507", _problem(507))
        answers.setdefault("415", _problem(415))
