"""Keys that a JSON object has twice: parsers silently keep the last one, while the first may be the intended one."""

from __future__ import annotations

import json
from contextlib import suppress

from fastapi import Request
from fastapi.concurrency import run_in_threadpool

from sprung.service.api.problems import SHOWN_ERRORS, ApiProblem

LOOKED_AT_BY_ROUTE = ("/identify",)  # which is asked a thousand times as often as all others, and has a quicker way
AT_ONCE = 20_000  # bytes; longer bodies are looked at in a thread


def duplicate_keys(content: bytes) -> list[str]:
    """Names that an object of the document has more than once, in the order in which their objects end.

    Empty for invalid JSON, which its reader reports.
    """
    found: dict[str, None] = {}

    def note(pairs: list[tuple[str, object]]) -> None:
        names: set[str] = set()
        for name, _ in pairs:
            if name in names:
                found[name] = None
            names.add(name)

    with suppress(ValueError, RecursionError):
        json.loads(content, object_pairs_hook=note)
    return list(found)


async def refuse_duplicate_keys(request: Request) -> None:
    """422 for a JSON body with an object that names a key twice."""
    kind = request.headers.get("content-type", "application/json").split(";")[0].strip().lower()
    if request.method in ("GET", "HEAD") or kind != "application/json" or request.url.path in LOOKED_AT_BY_ROUTE:
        return
    content = await request.body()
    names = duplicate_keys(content) if len(content) < AT_ONCE else await run_in_threadpool(duplicate_keys, content)
    if names:
        errors = [{"field": name[:160], "detail": "is there twice"} for name in names[:SHOWN_ERRORS]]
        raise ApiProblem(422, f"{errors[0]['field']} is there twice", errors)
