"""What computes behind the door of Ray Serve.

Whoever starts the replicas imports these classes, too, and should not wait for torch before Ray's own processes start:
what they compute with is imported where a replica begins.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import numpy as np

from sprung.model.signals import MeasurementFault
from sprung.service.errors import UserError
from sprung.service.fleet.message import IngestResult, Message, SentWindows, WindowEstimate
from sprung.service.monitoring.form import WindowForm
from sprung.service.processes.imports import lasting_imports
from sprung.service.processes.threads import one_thread_each
from sprung.service.settings import Settings
from sprung.service.store import open_store


class ComputeReplica:
    """Windows of any vehicles -> estimates; messages of any vehicles -> trackers and store.

    One process for both: each would have to import the same for seconds, and of two that do one thing each, one is idle
    while the other one has too much.
    """

    def __init__(self, settings: Settings, migrated: bool = False) -> None:
        """migrated: the store has been, and need not be looked at."""
        one_thread_each()
        with lasting_imports():
            from sprung.service.fleet.ingest import Ingest
            from sprung.service.monitoring.compute import Compute
            from sprung.service.monitoring.engine import load_engine
            from sprung.service.monitoring.pipeline import Pipeline

            self._engine = load_engine(settings)
        self._identifying = asyncio.Lock()  # an identifier is for one thread at a time
        store = open_store(settings.store_url, migrated)
        pipeline = Pipeline(self._engine, store, Compute(1), vehicles_in_memory=settings.vehicles_in_memory)
        self._ingest = Ingest(pipeline, settings.late_seconds)
        self._ingest.start()

    async def form(self) -> WindowForm:
        """What windows have to look like."""
        return self._engine.form

    async def take(
        self, sent: Sequence[SentWindows], known: Sequence[tuple[MeasurementFault, ...]]
    ) -> list[IngestResult | UserError]:
        """Identify windows of some vehicles together, then fold them as `fold` does: what became of each one's.

        known: faults of each one's vehicle, as `Engine.identify` has them.
        """
        starts = [start for one in sent for start in one.starts]
        values = np.concatenate([one.values for one in sent])
        faults = [of for one, of in zip(sent, known, strict=True) for _ in one.starts]
        async with self._identifying:
            found = (await asyncio.to_thread(self._engine.identify, values, starts=starts, known=faults))[0]
        estimates = iter(found)
        messages = [
            Message(
                one.vehicle,
                self._engine.digest,
                tuple(WindowEstimate(start, "used", None, 0, False, next(estimates)) for start in one.starts),
            )
            for one in sent
        ]
        return await self.fold(messages)

    async def fold(self, messages: Sequence[Message]) -> list[IngestResult | UserError]:
        """What became of each message; they are stored, but for those with an error."""
        return await asyncio.to_thread(self._fold, messages)

    def _fold(self, messages: Sequence[Message]) -> list[IngestResult | UserError]:
        try:
            return list(self._ingest.take(messages))
        except UserError as error:  # one of them spoils it for the others
            return [error] if len(messages) == 1 else [self._fold([one])[0] for one in messages]
