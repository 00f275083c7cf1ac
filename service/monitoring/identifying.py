"""Identifying in a process of its own, see `service.processes.forked`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from sprung.model.identifier import Identifies, StageTimes
from sprung.model.signals import Estimate, FloatArray
from sprung.service.monitoring.engine import one_thread_an_operation
from sprung.service.processes.forked import ForkedFunctions, ProcessEnded


class IdentifierApart:
    """An identifier in a process of its own; in this one from when that has ended."""

    def __init__(self, identifier: Identifies) -> None:
        self.digest = identifier.digest
        self.times = StageTimes()
        self._here = identifier
        self.forked = ForkedFunctions(
            "identifies windows", {"ask": partial(_asked, identifier)}, one_thread_an_operation
        )

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """As that of the identifier."""
        return self._ask("identify", windows, start, states=states)

    @property
    def examine(self) -> Callable[..., list[Estimate]] | None:
        """That of the identifier, where it has one."""
        return partial(self._ask, "examine") if hasattr(self._here, "examine") else None

    def _ask(self, what: str, *given: Any, **named: Any) -> list[Estimate]:
        try:
            found, self.times = self.forked.call("ask", what, *given, **named)
        except ProcessEnded:
            found, self.times = _asked(self._here, what, *given, **named)
        return list(found)


def _asked(identifier: Identifies, what: str, *given: Any, **named: Any) -> tuple[list[Estimate], StageTimes]:
    return getattr(identifier, what)(*given, **named), identifier.times
