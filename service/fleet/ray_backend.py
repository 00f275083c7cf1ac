"""What the door of Ray Serve passes requests on to.  Imported by the door's replica alone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from cachetools import LRUCache

from sprung.model.signals import MeasurementFault
from sprung.service.errors import Busy, UserError
from sprung.service.fleet.message import IngestResult, Message, SentWindows, read_messages
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.monitoring.form import WindowForm

_Asked = tuple[SentWindows, tuple[MeasurementFault, ...]]  # windows, and what is wrong with their vehicle's sensors
MOST_FAULTY = 10_000  # vehicles whose faults are held; one that is heard from again is told anew with its first window


class RayBackend:
    """What the door sees of them.  Requests are put together here: a call costs more than a window's identification,
    so that one carries the windows, or the messages, of all that ask at a time."""

    def __init__(self, compute: Any, sizes: ServingSizes, batch: Callable[..., Any]) -> None:
        """compute: handle of the deployment; batch: `serve.batch`, which runs in a replica only."""
        self._compute = compute
        self._form: WindowForm | None = None
        self._faults: LRUCache[str, tuple[MeasurementFault, ...]] = LRUCache(MOST_FAULTY)  # where there are any
        self._waiting, self._most = 0, sizes.queued * sizes.replicas
        # one more than there are replicas, so that none waits for the next; more, and batches stay small
        wait = {"batch_wait_timeout_s": sizes.batch_wait_seconds, "max_concurrent_batches": sizes.replicas + 1}
        self._taken = batch(max_batch_size=sizes.batch_windows, batch_size_fn=_windows_of, **wait)(self._take_together)
        self._folded = batch(max_batch_size=sizes.batch_messages, **wait)(self._fold_together)

    async def form(self) -> WindowForm:
        """What windows look like, from a replica; waits for the first of them."""
        if self._form is None:
            self._form = await _asked(self._compute.form.remote())
        return self._form

    async def fold(self, body: bytes) -> IngestResult:
        """Fold a message."""
        with self._place():
            return self._learned(await self._folded((await asyncio.to_thread(read_messages, [body]))[0]))

    async def identify_and_fold(self, sent: SentWindows) -> IngestResult:
        """Identify windows, together with those of others, and fold them together."""
        with self._place():
            taken: IngestResult | UserError = await self._taken((sent, self._faults.get(sent.vehicle, ())))
            return self._learned(taken)

    @contextmanager
    def _place(self) -> Iterator[None]:
        """One of those who wait.  Raises Busy when there are too many."""
        if self._waiting >= self._most:
            raise Busy("too many requests wait; try again in a second")
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1

    def _learned(self, taken: IngestResult | UserError) -> IngestResult:
        if isinstance(taken, UserError):
            raise taken
        self._learn(taken)
        return taken

    def _learn(self, taken: IngestResult) -> None:
        """What is wrong with a vehicle's sensors, for its next windows."""
        self._faults.pop(taken.vehicle, None)
        if taken.faults:
            self._faults[taken.vehicle] = taken.faults

    async def _take_together(self, asked: list[_Asked]) -> list[IngestResult | UserError]:
        sent, known = zip(*asked, strict=True)
        found: list[IngestResult | UserError] = await _asked(self._compute.take.remote(list(sent), list(known)))
        return found

    async def _fold_together(self, messages: list[Message]) -> list[IngestResult | UserError]:
        found: list[IngestResult | UserError] = await _asked(self._compute.fold.remote(messages))
        return found


def _windows_of(asked: list[_Asked]) -> int:
    return sum(len(sent.starts) for sent, _ in asked)


async def _asked(pending: Any) -> Any:
    from ray.exceptions import RayError, RayTaskError

    try:
        return await pending
    except RayTaskError as error:
        raise error.cause from None
    except RayError as error:  # another one takes its place
        raise Busy(f"a replica ended with the request in its hands ({type(error).__name__}); try again") from error
