"""Identifying in processes of their own, see `service.processes.forked`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from cachetools import LRUCache

from sprung.model.identifier import Identifies, StageTimes
from sprung.model.schema import SystemFile
from sprung.model.signals import BoolArray, Estimate, FloatArray, MeasurementFault
from sprung.model.system import System
from sprung.service.monitoring.engine import one_thread_an_operation, own_identifier
from sprung.service.processes.forked import ForkedFunctions, ProcessEnded

KEPT = 16  # identifiers of single vehicles in their process
NICE = 10  # of that process: where processors are scarce, the windows of all other vehicles come first


class IdentifierApart:
    """An identifier in a process of its own; in this one while there is none."""

    def __init__(self, here: Identifies, ask: Callable[..., Any]) -> None:
        """ask: as `_asked`, in the process."""
        self.digest = here.digest
        self.times = StageTimes()
        self._here = here
        self._ask_there = ask

    def identify(
        self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False, loads: bool = False
    ) -> list[Estimate]:
        """As that of the identifier."""
        return self._ask("identify", windows, start, states=states, loads=loads)

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        """As that of the identifier."""
        return self._ask("examine", windows, weigh, known)

    def _ask(self, what: str, *given: Any, **named: Any) -> list[Estimate]:
        try:
            found, self.times = self._ask_there(what, *given, **named)
        except ProcessEnded:
            found, self.times = _asked(self._here, what, *given, **named)
        return list(found)


def identifying_processes(identifier: Identifies, system: System) -> tuple[ForkedFunctions, ForkedFunctions]:
    """Two processes: for windows of vehicles with the service's system file, and for those of vehicles with their own.

    system: the service's, by whose laws the system files of vehicles are read.
    """
    shared, own = {"ask": partial(_asked, identifier)}, {"ask": _OwnIdentifiers(system).ask}
    return (
        ForkedFunctions("identifies windows", shared, one_thread_an_operation),
        ForkedFunctions("identifies windows with vehicles' own models", own, _begin_behind),
    )


def placed_in(process: ForkedFunctions) -> Callable[[System, Identifies], Identifies]:
    """`Engine.place`: where windows of vehicles with models of their own, which may take seconds each, are identified.

    process: the second one of `identifying_processes`.
    """
    return lambda system, here: IdentifierApart(here, partial(process.call, "ask", here.digest, system.file))


def _begin_behind() -> None:
    one_thread_an_operation()
    os.nice(NICE)


class _OwnIdentifiers:
    """The last ones that were asked for, in the process for vehicles with models of their own."""

    def __init__(self, system: System) -> None:
        self._shared = system
        self._held: LRUCache[str, Identifies] = LRUCache(KEPT)

    def ask(self, digest: str, file: SystemFile, what: str, *given: Any, **named: Any) -> tuple[Any, StageTimes]:
        """As `_asked`, of the identifier of a system file."""
        identifier = self._held.get(digest)
        if identifier is None:
            identifier = self._held[digest] = own_identifier(System(file, self._shared.catalogue))
        return _asked(identifier, what, *given, **named)


def _asked(identifier: Identifies, what: str, *given: Any, **named: Any) -> tuple[list[Estimate], StageTimes]:
    return getattr(identifier, what)(*given, **named), identifier.times
