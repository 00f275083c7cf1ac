"""Cache of fits, for repeated diagnoses of one recording under other rules."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from sprung.model.diagnosis.record.signals import Noise, Part
from sprung.model.diagnosis.response.point import Point
from sprung.model.system import System

Known = TypeVar("Known")


class FitMemory:
    """Results by their arguments, recording and start by value.  Thread-safe.

    Concurrent requests for one result may compute it twice; the results are equal.
    """

    def __init__(self) -> None:
        self._known: dict[object, Any] = {}

    def recall(self, key: object, make: Callable[[], Known]) -> Known:
        """The result of a key, computed if it is not cached."""
        if key not in self._known:
            self._known[key] = make()
        known: Known = self._known[key]
        return known


def key_of(system: System, part: Part, noise: Noise, start: Point, *others: object) -> bytes:
    """A key for a fit; `others`: further arguments, arrays or plain values."""
    digest = hashlib.blake2b(digest_size=16)
    arrays = [*system.mechanics.matrices(), part.sensors, part.support, part.force]
    arrays += [noise.sensors, noise.displacement, noise.velocity, noise.force]
    arrays += [start.theta, start.state, *start.warm_start, *(one for one in others if isinstance(one, np.ndarray))]
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    for term in start.terms:
        digest.update(repr((term.key, term.parameters, term.equivalent, term.scales, term.fixed, term.known)).encode())
    digest.update(repr([one for one in others if not isinstance(one, np.ndarray)]).encode())
    return digest.digest()
