"""The inputs that a run gives a system, clean, and the system with the run's load."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from sprung.model.experiment.menu import BenchSignal, MenuRun
from sprung.model.identification.excitation import ERRI_LOW, simulate_runs
from sprung.model.identification.nonlinear.with_laws import without_laws
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.system import System

_FINE = 32  # points per sample of the spline that signals are differentiated by
_RAMP = 1.0  # s, in which a signal grows from nothing
_LINES = 200  # of noise


def loaded(system: System, run: MenuRun) -> System:
    """The system with the run's load in its bodies."""
    bodies = dict(system.file.bodies)
    for name, more in run.load.items():
        body = bodies[name]
        factor = 1 + more / body.mass.value
        changed = {"mass": body.mass.model_copy(update={"value": body.mass.value * factor})}
        for inertia in ("roll_inertia", "pitch_inertia"):
            value = getattr(body, inertia)
            changed |= {} if value is None else {inertia: value * factor}
        bodies[name] = body.model_copy(update=changed)
    return System(system.file.model_copy(update={"bodies": bodies}), system.catalogue)


def run_inputs(system: System, run: MenuRun, seed: int = 0) -> FloatArray:
    """Samples (T, I) of the measured inputs, without their noise; seed: of track and noise."""
    rng = np.random.default_rng(seed)
    samples = round(run.seconds * system.sample_rate)
    if run.track is not None:
        bare, level = without_laws(system), run.track.level * ERRI_LOW
        speed = (run.track.speed, run.track.speed)
        found = simulate_runs(bare, np.zeros((1, len(bare.parameters))), samples, rng, speed, (level, level))
        return found.clean[0, :, : len(system.inputs)]
    assert run.signal is not None
    t = np.arange(samples) / system.sample_rate
    fine = np.arange(_FINE * (samples - 1) + 1) / (_FINE * system.sample_rate)
    spline = CubicSpline(fine, _shape(run.signal, fine, run.seconds, rng))
    values = np.zeros((samples, len(system.inputs)))
    for name, drive in zip(system.file.inputs, drives_of(system), strict=True):
        if run.signal.inputs and name not in run.signal.inputs:
            continue
        for order, column in drive.columns.items():
            values[:, column] = spline(t, order)
    return values


def _shape(signal: BenchSignal, t: FloatArray, seconds: float, rng: np.random.Generator) -> FloatArray:
    ramp = np.sin(0.5 * np.pi * np.clip(t / _RAMP, 0, 1)) ** 2
    low, high = signal.frequency, signal.to or signal.frequency
    if signal.kind == "sine":
        wave = np.sin(2 * np.pi * low * t)
    elif signal.kind == "sweep":
        wave = np.sin(2 * np.pi * (low * t + 0.5 * (high - low) / seconds * t**2))
    else:
        lines, phases = rng.uniform(low, high, _LINES), rng.uniform(0, 2 * np.pi, _LINES)
        wave = np.sqrt(2 / _LINES) * sum(
            np.sin(2 * np.pi * f * t + phase) for f, phase in zip(lines, phases, strict=True)
        )
    found: FloatArray = signal.amplitude * ramp * wave
    return found
