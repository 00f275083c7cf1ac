"""How faults of a set-up are undone: changes of recorded signals, or of the system file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sprung.model.diagnosis.record.signals import Signals
from sprung.model.schema import Element, MotionSensor
from sprung.model.signals import FloatArray
from sprung.model.system import System

Undo = Callable[[System, Signals], tuple[System, Signals]]
_EDGE = 5  # samples beside a cut that a shift between samples spoils


def turn(sensors: Sequence[int] = (), supports: Sequence[int] = (), forces: Sequence[int] = ()) -> Undo:
    """The other sign."""
    return scale(sensors, supports, -1.0, forces)


def scale(sensors: Sequence[int], supports: Sequence[int], ratio: float, forces: Sequence[int] = ()) -> Undo:
    """Divided by what they were too large by."""

    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        return system, _changed(signals, sensors, supports, forces, lambda columns: columns / ratio)

    return undo


def exchange(sensors: Sequence[tuple[int, int]] = (), supports: Sequence[tuple[int, int]] = ()) -> Undo:
    """Pairs of channels in each other's place."""

    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        copies: dict[str, Any] = {}
        for key, pairs in (("sensors", sensors), ("displacement", supports), ("velocity", supports)):
            series = getattr(signals, key).copy()
            for i, j in pairs:
                series[:, [i, j]] = series[:, [j, i]]
            copies[key] = series
        there = dict(supports) | {j: i for i, j in supports}
        fused = tuple(replace(one, support=there.get(one.support, one.support)) for one in signals.fused)
        return system, replace(signals, **copies, fused=fused)

    return undo


def advance(sensors: Sequence[int], supports: Sequence[int], late: float, forces: Sequence[int] = ()) -> Undo:
    """Earlier by a delay; what they no longer have at the ends is cut off of all signals."""

    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        rate, samples = signals.sample_rate, signals.samples
        time, omega = np.arange(samples) / rate, 2 * np.pi * np.fft.rfftfreq(samples, 1 / rate)

        def earlier(series: FloatArray) -> FloatArray:
            """Columns (T, m) by band-limited interpolation, the line through their ends aside."""
            line = series[:1] + (series[-1:] - series[:1]) * (time / time[-1])[:, None]
            spectrum = np.fft.rfft(series - line, axis=0) * np.exp(1j * omega * late)[:, None]
            return np.asarray(np.fft.irfft(spectrum, samples, axis=0) + line)

        lost = int(np.ceil(abs(late) * rate)) + _EDGE
        return system, _changed(signals, sensors, supports, forces, earlier).part(lost, samples - lost)

    return undo


def _changed(
    signals: Signals,
    sensors: Sequence[int],
    supports: Sequence[int],
    forces: Sequence[int],
    change: Callable[[FloatArray], FloatArray],
) -> Signals:
    """Signals with everything that is measured at some places changed alike, as columns (T, m)."""
    copies: dict[str, Any] = {}
    for key, at in (("sensors", sensors), ("displacement", supports), ("velocity", supports), ("force", forces)):
        series = getattr(signals, key).copy()
        measured = [i for i in at if np.isfinite(series[0, i])]
        series[:, measured] = change(series[:, measured])
        copies[key] = series
    fused = tuple(one.changed(change) if one.support in supports else one for one in signals.fused)
    return replace(signals, **copies, fused=fused)


def _with_part(system: System, kind: str, name: str, part: Element | MotionSensor) -> System:
    """The system with a part of its file exchanged, its catalogue of laws kept."""
    return replace(system, file=system.file.model_copy(update={kind: {**getattr(system.file, kind), name: part}}))


def moved_sensor(system: System, name: str, axis: int, offset: float) -> System:
    """The system with a sensor elsewhere along an axis, m."""
    sensor = system.file.sensors[name]
    assert isinstance(sensor, MotionSensor)
    position = list(sensor.position or system.file.bodies[sensor.body].position)
    position[axis] += offset
    return _with_part(system, "sensors", name, sensor.model_copy(update={"position": (position[0], position[1])}))


def moved_element(system: System, name: str, axis: int, offset: float) -> System:
    """The system with an element elsewhere along an axis, m."""
    element = system.file.elements[name]
    position = list(element.position or (0.0, 0.0))
    position[axis] += offset
    return _with_part(system, "elements", name, element.model_copy(update={"position": (position[0], position[1])}))


def attached(system: System, name: str, end: str, to: str) -> System:
    """The system with one end of an element at something else."""
    return _with_part(system, "elements", name, system.file.elements[name].model_copy(update={end: to}))


def in_system(change: Callable[[System], System]) -> Undo:
    """A change of the system file alone."""

    def undo(system: System, signals: Signals) -> tuple[System, Signals]:
        return change(system), signals

    return undo
