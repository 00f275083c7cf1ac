"""Vehicles with models of their own take turns, each of about the same time, whatever their windows take."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

from sprung.service.monitoring.engines import ServedModel
from sprung.service.store.vehicle_models import SERVICE_FILE

TURN_SECONDS = 1.0
MOST = 8  # windows of one turn: should they suddenly take as long as they may, others wait for that many

T = TypeVar("T")


class Pace:
    """How long windows take with the models of single vehicles."""

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}  # of the last ones, for one, by row of `models`

    def windows(self, served: ServedModel, most: int) -> int:
        """So many of a vehicle's windows make a turn; one until it is known how long they take.

        All that others may have (`most`) with the service's own system file.
        """
        if served.version == SERVICE_FILE:
            return most
        seconds = self._seconds.get(served.model_id, TURN_SECONDS)
        return min(most, MOST, max(1, int(TURN_SECONDS / max(seconds, 1e-9))))

    def note(self, served: ServedModel, windows: int, seconds: float) -> None:
        """So many windows took so long."""
        if served.version != SERVICE_FILE and windows:
            self._seconds[served.model_id] = seconds / windows


class FairQueues(Generic[T]):
    """What waits, in queues by key; each queue has its turn, and goes behind the others then.  Not thread-safe."""

    def __init__(self, key: Callable[[T], Hashable]) -> None:
        self._key = key
        self._queues: OrderedDict[Hashable, deque[T]] = OrderedDict()

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def __iter__(self) -> Iterator[T]:
        """In the order of turns, the whole of a queue at once."""
        for queue in self._queues.values():
            yield from queue

    def alike(self, item: T) -> int:
        """How many wait in the same queue."""
        return len(self._queues.get(self._key(item), ()))

    def append(self, item: T) -> None:
        """Behind those of its queue."""
        self._queues.setdefault(self._key(item), deque()).append(item)

    def take(self, most: Callable[[T], int]) -> list[T]:
        """The turn of the first queue; most: of it, by its first item."""
        if not self._queues:
            return []
        key, queue = self._queues.popitem(last=False)
        taken = [queue.popleft() for _ in range(min(len(queue), most(queue[0])))]
        if queue:
            self._queues[key] = queue
        return taken

    def clear(self) -> list[T]:
        """All that waited."""
        everything = list(self)
        self._queues.clear()
        return everything
