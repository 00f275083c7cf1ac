"""`Idempotency-Key`: a request that is sent twice is carried out once.

As in the draft of the IETF (draft-ietf-httpapi-idempotency-key-header): the first answer is kept for a day and given
again, also where the service was killed before it was sent; the same key for another request is refused, and so is one
whose first request is still being worked on.  A request is its method, path and body; of an upload, the file, its name
and the other fields count.  Keys of callers that differ in name, fleet or scopes have nothing to do with each other.
Answers age by the clock of retention, which takes no leap of the host's.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection, Row, delete, insert, select
from sqlalchemy.exc import IntegrityError

from sprung.service.api.access import CoreOf
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.api.problems import ApiProblem
from sprung.service.api.scopes import FORM, content_kind
from sprung.service.api.uploads import identity_of
from sprung.service.core import Core
from sprung.service.housekeeping import LONGEST_PAUSE
from sprung.service.store.schema import idempotency
from sprung.service.times import NANOSECONDS

T = TypeVar("T")
KEPT = LONGEST_PAUSE + 86_400 * NANOSECONDS  # a day, though the host's clock leaps while the service is stopped
Key = Annotated[
    str | None,
    # an empty one, as of a variable that was never set, would be that of all requests of a client
    Header(alias="Idempotency-Key", min_length=1, max_length=200, description="sent twice, carried out once"),
]


class KeysAtWork:
    """Keys of the requests of one application that are being worked on."""

    def __init__(self) -> None:
        self._keys: set[str] = set()
        self._lock = threading.Lock()

    @contextmanager
    def holding(self, key: str) -> Iterator[None]:
        """While a request is carried out; raises ApiProblem for a second one."""
        with self._lock:
            if key in self._keys:
                raise _at_work()
            self._keys.add(key)
        try:
            yield
        finally:
            with self._lock:
                self._keys.discard(key)


class IdempotentRequests:
    """Carries a request out unless an answer to its key is there."""

    def __init__(self, core: Core, key: str | None, request: Request, parts: list[bytes]) -> None:
        """key: unique per caller; parts: content that distinguishes the request, without an upload."""
        self._core = core
        self._key = key
        self._http = request
        self._parts = parts
        self._upload = b""
        self._response: Response | None = None

    def received(self, identity: str) -> None:
        """Set the identity of the upload, before the answer is kept."""
        self._upload = identity.encode()

    def keeping(self, respond: Callable[[Connection, T], Response]) -> Callable[[Connection, T], None]:
        """What a deed has to call inside its transaction with what came of it: makes the answer, and keeps it there.

        So deed and answer are stored together or not at all, whenever the process dies.
        """

        def work(connection: Connection, found: T) -> None:
            self._response = respond(connection, found)
            if self._key is not None:
                self._keep(connection, self._response)

        return work

    async def answer(self, act: Callable[[], Awaitable[None]]) -> Response:
        """The answer that `act` has kept, or the one that was given before.  Errors are not kept."""
        if self._key is None:
            return await self._carried_out(act)
        at_work: KeysAtWork = self._http.app.state.keys_at_work
        with at_work.holding(self._key):
            kept = await run_in_threadpool(self._find)
            return await self._carried_out(act) if kept is None else await self._again(kept)

    async def _carried_out(self, act: Callable[[], Awaitable[None]]) -> Response:
        await act()
        assert self._response is not None, "a deed without `keeping`"
        return self._response

    def _find(self) -> Row[Any] | None:
        table, now = idempotency, self._core.housekeeping.clock.read()
        with self._core.store.write() as connection:
            connection.execute(delete(table).where(table.c.created_ns < now - KEPT))
            return connection.execute(select(table).where(table.c.key == self._key)).first()

    async def _again(self, kept: Row[Any]) -> Response:
        if content_kind(self._http.headers) == FORM:
            self.received(await identity_of(self._http, self._core.settings))
        if kept.request != _digest(*self._parts, self._upload):
            detail = "was used for another request"
            raise ApiProblem(422, f"Idempotency-Key {detail}", [{"field": "Idempotency-Key", "detail": detail}])
        headers = {"Idempotency-Replayed": "true"} | ({"Location": kept.location} if kept.location else {})
        return json_response(kept.body, kept.status, headers)

    def _keep(self, connection: Connection, response: Response) -> None:
        row = {
            "key": self._key,
            "request": _digest(*self._parts, self._upload),
            "status": response.status_code,
            "body": json.loads(bytes(response.body)),
            "location": response.headers.get("location"),
            "created_ns": self._core.housekeeping.clock.read(),
        }
        try:
            connection.execute(insert(idempotency).values(**row))
        except IntegrityError:  # another process has carried it out meanwhile; here it is undone
            raise _at_work() from None


def _at_work() -> ApiProblem:
    return ApiProblem(409, "a request with this Idempotency-Key is being worked on", headers={"Retry-After": "1"})


async def once(request: Request, core: CoreOf, actor: ActorOf, key: Key = None) -> IdempotentRequests:
    """What a route needs to be carried out once; JSON bodies count as part of the request."""
    body = await request.body() if key is not None and content_kind(request.headers) == "application/json" else b""
    if key is not None:
        key = _digest(*(part.encode() for part in (actor.name, actor.fleet, *sorted(actor.scopes), key)))
    return IdempotentRequests(core, key, request, [request.method.encode(), request.url.path.encode(), body])


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


OnceOf = Annotated[IdempotentRequests, Depends(once)]
