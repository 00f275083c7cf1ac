"""Cases to recordings: batches through the integrator, then noise, faults, files and labels."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.draw import Case
from sprung.benchmarks.generator.exact import exact_response, is_linear
from sprung.benchmarks.generator.files import WRITERS
from sprung.benchmarks.generator.integrate import SAMPLE_RATE, WARM_UP, PlantBatch, Slot, simulate
from sprung.benchmarks.generator.oracle import SETTLE, oracle_snr, snr_of_each
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

SLACK = 0.6  # s simulated beyond the last sample, for the filter and for lags
FORMATS = ("mcap", "blf", "mcap", "log", "mcap", "asc")


def _plant(vehicle: Vehicle, cases: list[Case]) -> PlantBatch:
    batch = len(cases)
    inertia = np.repeat(vehicle.inertia[:, None], batch, 1)
    mode, drive = np.zeros((4, batch)), np.zeros((4, batch))
    mode[0] = 10.0
    slots = []
    for column, case in enumerate(cases):
        if case.mass_scale:
            inertia[vehicle.on_body(case.mass_scale[0]), column] *= case.mass_scale[1]
        if case.flex:
            mode[:, column] = [*case.flex[:3], 1.0]
        if case.drive:
            drive[:, column] = [*case.drive, np.random.default_rng(case.seed + 1).uniform(0, 2 * np.pi)]
        slots += [Slot(column, vehicle.elements.index(e), law, p) for e, law, p in case.effects]
    values = [[[getattr(c, q)[e] for c in cases] for e in vehicle.elements] for q in ("stiffness", "damping")]
    return PlantBatch(np.array(values[0]), np.array(values[1]), inertia, mode, drive, slots)


def _delayed(signal: Array, lag: float) -> Array:
    """A fractional delay by a windowed sinc; flat to about 45 Hz."""
    reach = 40
    whole = int(np.floor(lag * SAMPLE_RATE))
    n = np.arange(-reach, reach + 1)
    kernel = np.sinc(n - (lag * SAMPLE_RATE - whole)) * np.kaiser(2 * reach + 1, 8.0)
    padded = np.concatenate([np.full(reach + whole, signal[0]), signal, np.full(reach, signal[-1])])
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")[: signal.size]


def _faulty(vehicle: Vehicle, case: Case, clean: Array, samples: int) -> Array:
    """The true signals with the fault of a measuring chain that changes them before noise, (samples, channels)."""
    values = clean[:samples].copy()
    if case.fault:
        channel, kind, value = case.fault
        index = vehicle.channels.index(channel)
        if kind == "sensor_gain":
            values[:, index] *= value
        elif kind == "sensor_lag":
            values[:, index] = _delayed(clean[:, index], value)[:samples]
        elif kind == "sensor_bias":
            values[:, index] += value
    return values


def _noisy(vehicle: Vehicle, case: Case, values: Array) -> Array:
    """What is recorded: noise, more of it or none at all where that is the fault."""
    rng = np.random.default_rng(case.seed)
    scale = np.concatenate([vehicle.input_noise.ravel(), vehicle.sensor_noise])
    channel, kind, value = case.fault or ("", "", 0.0)
    if kind == "sensor_noise":
        scale[vehicle.channels.index(channel)] *= value
    values = values + rng.normal(size=values.shape) * scale
    if kind == "sensor_stuck":
        start = min(int(value * SAMPLE_RATE), len(values) // 2)
        index = vehicle.channels.index(channel)
        values[start:, index] = values[start, index]
    return values


@dataclass(frozen=True)
class MadeRecording:
    """One made recording and the truth about it."""

    case: Case
    values: Array  # measured, shape (T, C): displacements, velocities, sensors
    strengths: list[float]  # of each law: rms of its force over rms of the element's linear force
    snr: float | None  # of the oracle, see `oracle.py`


def make_recordings(
    vehicle: Vehicle,
    cases: list[Case],
    seconds: float = 60.0,
    batch: int = 32,
    progress: Callable[[str], None] | None = None,
) -> Iterator[MadeRecording]:
    """The recordings of the cases, in their order; linear vehicles by their exact response, the others integrated."""
    samples = round(seconds * SAMPLE_RATE)
    for first in range(0, len(cases), batch):
        group = cases[first : first + batch]
        hidden = [case for case in group if not is_linear(case)]
        said = (lambda part, n=first: progress(f"{n}+{part:.0%} of {len(cases)}")) if progress else None
        integrated = iter(_integrated(vehicle, hidden, seconds, said) if hidden else [])
        for case in group:
            clean, own = (exact_response(vehicle, case, seconds + 2), []) if is_linear(case) else next(integrated)
            faulty = _faulty(vehicle, case, clean, samples)
            snr = oracle_snr(vehicle, case, clean[:samples], faulty) if seconds > 2 * SETTLE else None
            yield MadeRecording(case, _noisy(vehicle, case, faulty), own, snr)


def _integrated(
    vehicle: Vehicle, group: list[Case], seconds: float, said: Callable[[float], None] | None
) -> Iterator[tuple[Array, list[float]]]:
    """True filtered signals and strengths of each case, integrated together."""
    tables = [
        track.wheels(
            np.random.default_rng(case.seed + 2),
            WARM_UP + seconds + SLACK + 2,
            case.speed,
            case.level,
            vehicle.input_position,
            vehicle.input_side,
            joint_spacing=case.joints,
        )
        for case in group
    ]
    displacement, velocity = (np.stack([t[i] for t in tables], axis=2) for i in (0, 1))
    plant = _plant(vehicle, group)
    clean, strength = simulate(vehicle, plant, displacement, velocity, seconds + SLACK / 2, said)
    for column in range(len(group)):
        own = [float(s) for s, slot in zip(strength, plant.slots, strict=True) if slot.column == column]
        yield clean[:, :, column], own


def make_with_each_missing(vehicle: Vehicle, case: Case, seconds: float = 60.0) -> tuple[Array, list[float]]:
    """What is measured of a case (T, C), and the signal-to-noise ratio of each of its laws beside the others."""
    samples, effects = round(seconds * SAMPLE_RATE), case.effects
    less = [replace(case, effects=effects[:i] + effects[i + 1 :]) for i in range(len(effects))]
    whole, *without = (clean[:samples] for clean, _ in _integrated(vehicle, [case, *less], seconds, None))
    return _noisy(vehicle, case, whole), snr_of_each(vehicle, case, whole, without)


def label(made: MadeRecording, seconds: float) -> dict[str, Any]:
    """One entry of labels.json, in the form of the published labels, with the generator's extras."""
    case = made.case
    entry: dict[str, Any] = {
        "verdict": case.verdict(),
        "seconds": seconds,
        "findings": case.findings(),
        "stiffness": case.stiffness,
        "damping": case.damping,
        **case.change,
        "kind": case.kind,
        "strength": made.strengths,
        "oracle_snr": made.snr,
        "speed": case.speed,
        "joints": case.joints,
        "track_level": case.level,
    }
    if case.flex:
        entry["flex"] = case.flex
    if case.drive:
        entry["drive"] = case.drive
    if case.mass_scale:
        entry["mass_scale"] = case.mass_scale[1]
    if case.fault:
        entry["sensor"] = list(case.fault)
    return entry


def write_set(
    vehicle: Vehicle,
    cases: list[Case],
    folder: Path,
    seconds: float = 60.0,
    formats: tuple[str, ...] = FORMATS,
    batch: int = 32,
    progress: Callable[[str], None] | None = None,
) -> Path:
    """Writes one file per case and labels.json (rewritten after every file); returns the labels' path."""
    folder.mkdir(parents=True, exist_ok=True)
    labels: dict[str, Any] = {}
    path = folder / "labels.json"
    for number, made in enumerate(make_recordings(vehicle, cases, seconds, batch, progress)):
        kind = formats[number % len(formats)]
        name = f"concealed-{number:03d}.{kind}"
        WRITERS[kind](folder / name, vehicle, made.values, f"concealed-{number:03d}")
        labels[name] = label(made, seconds)
        path.write_text(json.dumps(labels, indent=1), encoding="utf-8")
    return path
