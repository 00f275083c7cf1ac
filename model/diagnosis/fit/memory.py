"""Fits that are known already, for those who diagnose one recording again under other rules."""

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
    """Results by what goes into them, the recording and the start by value.  May be shared among threads.

    A result that two threads ask for at once is made twice; they are alike.
    """

    def __init__(self) -> None:
        self._known: dict[object, Any] = {}

    def recall(self, key: object, make: Callable[[], Known]) -> Known:
        """The result of a key, made where it is not known yet."""
        if key not in self._known:
            self._known[key] = make()
        known: Known = self._known[key]
        return known


def key_of(system: System, part: Part, noise: Noise, start: Point, *others: object) -> bytes:
    """A key for a fit; `others`: what else goes into it, arrays or plain values."""
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
