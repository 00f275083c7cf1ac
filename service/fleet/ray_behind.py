"""What the door of Ray Serve passes requests on to.  Imported by the door's replica alone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from sprung.model.signals import Estimate, FloatArray
from sprung.service.errors import Busy, UserError
from sprung.service.fleet.message import IngestResult, Message, SentWindows, WindowEstimate, read_messages
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.monitoring.form import WindowForm


class RayBehind:
    """What the door sees of the two.  Requests are put together here: a call costs more than a window's identification,
    so that one carries the windows, or the messages, of all that ask at a time."""

    def __init__(self, identify: Any, fold: Any, sizes: ServingSizes, batch: Callable[..., Any]) -> None:
        """identify, fold: handles of the deployments; batch: `serve.batch`, which runs in a replica only."""
        self._identify = identify
        self._fold = fold
        self._form: WindowForm | None = None
        self._waiting, self._most = 0, sizes.queued * sizes.replicas
        # one more than there are replicas, so that none waits for the next; more, and batches stay small
        wait = {"batch_wait_timeout_s": sizes.batch_wait_seconds, "max_concurrent_batches": sizes.replicas + 1}
        self._identified = batch(max_batch_size=sizes.batch_windows, **wait)(self._identify_together)
        self._folded = batch(max_batch_size=sizes.batch_messages, **wait)(self._fold_together)

    async def form(self) -> WindowForm:
        """What windows look like, from a replica that identifies; waits for the first of them."""
        if self._form is None:
            self._form = await _asked(self._identify.form.remote())
        return self._form

    async def fold(self, body: bytes) -> IngestResult:
        """Fold a message."""
        with self._place():
            return await self._fold_one((await asyncio.to_thread(read_messages, [body]))[0])

    async def identify_and_fold(self, sent: SentWindows) -> IngestResult:
        """Identify windows, together with those of others, and fold them together."""
        with self._place():
            ways = [self._identified(one) for one in zip(sent.starts, sent.values, strict=True)]
            estimates: list[Estimate] = await asyncio.gather(*ways)
            found = zip(sent.starts, estimates, strict=True)
            windows = tuple(WindowEstimate(start, "used", None, 0, False, estimate) for start, estimate in found)
            return await self._fold_one(Message(sent.vehicle, (await self.form()).digest, windows))

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

    async def _fold_one(self, message: Message) -> IngestResult:
        taken: IngestResult | UserError = await self._folded(message)
        if isinstance(taken, UserError):
            raise taken
        return taken

    async def _identify_together(self, asked: list[tuple[int, FloatArray]]) -> list[Estimate]:
        starts, values = [start for start, _ in asked], np.stack([values for _, values in asked])
        found: list[Estimate] = await _asked(self._identify.identify.remote(starts, values))
        return found

    async def _fold_together(self, messages: list[Message]) -> list[IngestResult | UserError]:
        found: list[IngestResult | UserError] = await _asked(self._fold.fold.remote(messages))
        return found


async def _asked(pending: Any) -> Any:
    from ray.exceptions import RayError, RayTaskError

    try:
        return await pending
    except RayTaskError as error:
        raise error.cause from None
    except RayError as error:  # another one takes its place
        raise Busy(f"a replica ended with the request in its hands ({type(error).__name__}); try again") from error
