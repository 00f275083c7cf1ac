"""Places for vehicles of which something large is held in memory: fewer than there may be vehicles."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


class Places(Generic[T]):
    """What is held of each vehicle that has a place.  Not safe to share between threads.

    Who has a place keeps it as long as it is heard from: where vehicles that report in turns pushed one another out,
    nothing would ever be held of any for more than a moment.  One that is urgent may have the place of one that is not.
    """

    def __init__(self, most: int, silent_seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        """silent_seconds: after which a vehicle that was not heard from makes room for another."""
        self._most = most
        self._silent = silent_seconds
        self._clock = clock
        self._held: OrderedDict[str, _Place[T]] = OrderedDict()  # heard from longest ago first

    def heard(self, vehicle: str, make: Callable[[], T], urgent: bool = False) -> T | None:
        """What is held of a vehicle that is heard from now, made where it is new; None where there is no place."""
        now, place = self._clock(), self._held.pop(vehicle, None)
        if place is None and len(self._held) >= self._most and not self._leave(now, urgent):
            return None
        held = make() if place is None else place.held
        self._held[vehicle] = _Place(held, now, urgent)
        return held

    def get(self, vehicle: str) -> T | None:
        """What is held of a vehicle."""
        place = self._held.get(vehicle)
        return None if place is None else place.held

    def all(self) -> dict[str, T]:
        """What is held, by vehicle."""
        return {vehicle: place.held for vehicle, place in self._held.items()}

    def pop(self, vehicle: str) -> None:
        """Hold nothing of it any more."""
        self._held.pop(vehicle, None)

    def _leave(self, now: float, urgent: bool) -> bool:
        """Make one leave: that heard from longest ago where it is silent, or the first that is not urgent."""
        for vehicle, place in self._held.items():
            if now - place.heard >= self._silent or (urgent and not place.urgent):
                del self._held[vehicle]
                return True
            if not urgent:
                return False
        return False


@dataclass(frozen=True, slots=True)
class _Place(Generic[T]):
    held: T
    heard: float  # s
    urgent: bool
