"""Measured against simulated: what the identified model makes of the samples that are still held of a vehicle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import Estimate, FloatArray
from sprung.service.engine import Engine
from sprung.service.errors import NotFound
from sprung.service.ring import Excerpt
from sprung.service.times import NANOSECONDS


@dataclass(frozen=True, slots=True)
class Compared:
    """One window."""

    start: int  # ns since epoch
    sample_rate: float  # Hz
    measured: FloatArray  # sensors, shape (T, S); NaN: absent
    simulated: FloatArray  # shape (T, S)
    estimate: Estimate


def newest_window(engine: Engine, excerpt: Excerpt | None, vehicle: str) -> tuple[int, FloatArray]:
    """Start and values (T, C) of the newest whole window that is held.  Raises NotFound where there is none."""
    if unmeasured(engine):
        raise NotFound(f"what moves {vehicle} is not measured, so there is nothing to simulate its sensors from")
    for start, values in reversed(list(whole_windows(engine, excerpt))):
        return start, values
    raise NotFound(f"no recent samples of {vehicle} are held; they are kept for a minute after they came")


def unmeasured(engine: Engine) -> bool:
    """Whether the system is identified from its sensors alone."""
    return engine.system.on_track or not engine.system.file.inputs


def whole_windows(engine: Engine, excerpt: Excerpt | None) -> Iterator[tuple[int, FloatArray]]:
    """Windows one after the other, oldest first, counted back from the newest sample; none with a missing input."""
    if excerpt is None or unmeasured(engine):
        return
    length, inputs = engine.system.window, len(engine.system.inputs)
    for first in range(len(excerpt.values) % length, len(excerpt.values) - length + 1, length):
        values = excerpt.values[first : first + length]
        present = np.isfinite(values)
        sensors = present[:, inputs:]
        if present[:, :inputs].all() and sensors.all(axis=0).any():
            holed = sensors.any(axis=0) & ~sensors.all(axis=0)  # a sensor with a gap counts as absent
            values = values.copy()
            values[:, inputs:][:, holed] = np.nan
            yield excerpt.start + round(first * NANOSECONDS / excerpt.sample_rate), values


def compare(engine: Engine, start: int, values: FloatArray) -> Compared:
    """Identify one window (T, C) and simulate its sensors; for the thread of the numerics."""
    import torch  # as the engine does: it takes a second

    from sprung.model.simulate.linear import LinearSimulator

    estimates, _ = engine.identify(values[None], states=True)
    estimate = estimates[0]
    assert estimate.states is not None
    inputs = len(engine.system.inputs)
    if estimate.outputs is not None:
        return Compared(start, engine.system.sample_rate, values[:, inputs:], estimate.outputs, estimate)
    simulator = LinearSimulator(engine.system)
    drives = torch.as_tensor(simulator.knots(values[None, :, :inputs]))[0]
    discrete = simulator.discretise(simulator.element_values(torch.as_tensor(estimate.log_ratio)[None]))
    outputs = torch.as_tensor(estimate.states) @ discrete.C[0].T + drives @ discrete.D[0].T
    return Compared(start, engine.system.sample_rate, values[:, inputs:], outputs.numpy(), estimate)
