"""What computes behind the door of Ray Serve.

Whoever starts the replicas imports these classes, too, and should not wait for torch before Ray's own processes start:
what they compute with is imported where a replica begins.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from sprung.model.signals import Estimate, FloatArray, MeasurementFault
from sprung.service.errors import UserError
from sprung.service.fleet.message import IngestResult, Message
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

    async def identify(
        self, starts: list[int], values: FloatArray, known: list[tuple[MeasurementFault, ...]]
    ) -> list[Estimate]:
        """The estimates of windows, values (B, T, C); known: faults of each one's vehicle, as `Engine.identify` has
        them."""
        async with self._identifying:
            return (await asyncio.to_thread(self._engine.identify, values, starts=starts, known=known))[0]

    async def fold(self, messages: Sequence[Message]) -> list[IngestResult | UserError]:
        """What became of each message; they are stored, but for those with an error."""
        return await asyncio.to_thread(self._fold, messages)

    def _fold(self, messages: Sequence[Message]) -> list[IngestResult | UserError]:
        try:
            return list(self._ingest.take(messages))
        except UserError as error:  # one of them spoils it for the others
            return [error] if len(messages) == 1 else [self._fold([one])[0] for one in messages]
