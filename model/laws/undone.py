"""Correction of recorded signals for known faults of measurements in the system file."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sprung.model.laws.kinds import SensorLaw
from sprung.model.laws.placed import PlacedLaw
from sprung.model.signals import FloatArray


def undone(values: FloatArray, channels: Sequence[str], laws: Sequence[PlacedLaw], sample_rate: float) -> FloatArray:
    """Channels as they would be without the faults that `laws` state; values (..., T, C), a copy where one is changed.

    A law at an input without quantity counts for all its channels.  Signals that are lost (stuck) stay as they are.
    """
    result = values
    for placed in laws:
        law = placed.law
        if not isinstance(law, SensorLaw) or law.stuck:
            continue
        for column, name in enumerate(channels):
            if any(name == place or name.startswith(f"{place}.") for place in placed.places):
                result = result.copy() if result is values else result
                result[..., column] = law.restore(result[..., column], placed.values, sample_rate)
    return result


def is_modelled(placed: PlacedLaw, sensors: Collection[str]) -> bool:
    """Whether a law is a filter of a sensor, which a model of the whole recording contains, with what it remembers."""
    return placed.law.filters and placed.location in sensors
