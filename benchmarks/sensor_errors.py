"""`sprung bench sensor-errors [--count 60] [--seed 1]`: errors of sensors that are in no list, on the bundled vehicle.

One accelerometer of a recording of the independent generator shows what its own electronics make of the motion: a
hum, a range that is too small, a curve, a filter without lag, a loose contact, another channel's signal, a gain that
drifts, a value held too long, noise that begins on the way, its zero elsewhere from some moment on; or the clock of a
whole node drifts.  Every other recording has a concealed effect as well.  Counted are

    sensor    exactly the falsified channels are named as faults
    physics   the concealed effect is named at its place, or nothing is where there is none
    blamed    something is named at a spring, damper or body that is not there

Yields one line per recording from number `first` on, and the rates.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.setups import RATE, FalsifiedRecording, in_order, sensors_on
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.system import MANCHESTER, System, load_system

Array = NDArray[np.float64]
SECONDS = 40.0
EFFECTS = ["coulomb_friction", "bump_stop", "series_stiffness", "damper_blowoff", "mass_change"]


def _hum(shown: Array, other: Array, random: np.random.Generator) -> Array:
    size, frequency = random.uniform(0.05, 0.5) * shown.std(), random.choice([16.7, random.uniform(3, 30)])
    return np.asarray(shown + size * np.sin(2 * np.pi * (frequency * np.arange(len(shown)) / RATE + random.random())))


def _cut_off(shown: Array, other: Array, random: np.random.Generator) -> Array:
    return np.asarray(np.clip(shown, *(np.array([-1, 1]) * random.uniform(1.2, 2.2) * shown.std())))


def _curved(shown: Array, other: Array, random: np.random.Generator) -> Array:
    return np.asarray(shown + random.choice([-1, 1]) * random.uniform(0.03, 0.2) * shown**2 / shown.std())


def _smoothed(shown: Array, other: Array, random: np.random.Generator) -> Array:
    sections = signal.butter(2, random.uniform(6, 15), fs=RATE, output="sos")
    return np.asarray(signal.sosfiltfilt(sections, shown))


def _loose(shown: Array, other: Array, random: np.random.Generator) -> Array:
    changed = shown.copy()
    for start in random.integers(50, len(shown) - 50, int(random.integers(6, 30))):
        changed[start : start + int(random.integers(2, 12))] = 0.0
    return changed


def _cross_talk(shown: Array, other: Array, random: np.random.Generator) -> Array:
    return np.asarray(shown + random.uniform(0.1, 0.4) * shown.std() / other.std() * other)


def _drifting_gain(shown: Array, other: Array, random: np.random.Generator) -> Array:
    return np.asarray(shown * (1 + random.choice([-1, 1]) * random.uniform(0.05, 0.2) * np.linspace(0, 1, len(shown))))


def _held(shown: Array, other: Array, random: np.random.Generator) -> Array:
    every = int(random.integers(2, 4))
    return np.asarray(np.repeat(shown[::every], every)[: len(shown)])


def _noise_on_the_way(shown: Array, other: Array, random: np.random.Generator) -> Array:
    begins = int(random.uniform(0.2, 0.6) * len(shown))
    noise = random.uniform(0.05, 0.2) * shown.std() * random.standard_normal(len(shown))
    return np.asarray(np.where(np.arange(len(shown)) >= begins, shown + noise, shown))


def _other_zero(shown: Array, other: Array, random: np.random.Generator) -> Array:
    begins = int(random.uniform(0.2, 0.6) * len(shown))
    return np.asarray(shown + random.uniform(0.3, 1.0) * shown.std() * (np.arange(len(shown)) >= begins))


ERRORS: dict[str, Callable[[Array, Array, np.random.Generator], Array]] = {
    "hum": _hum,
    "cut off": _cut_off,
    "curved": _curved,
    "smoothed": _smoothed,
    "loose contact": _loose,
    "cross-talk": _cross_talk,
    "drifting gain": _drifting_gain,
    "held": _held,
    "noise on the way": _noise_on_the_way,
    "another zero": _other_zero,
}
CLOCK = "drifting clock"
KINDS = (*ERRORS, CLOCK)


def run(count: int = 60, seed: int = 1, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording from number `first` on, and the rates."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    half = -(-count // 2)
    clean = draw_cases(vehicle, half, seed, ["clean"])
    hidden = draw_cases(vehicle, half, seed + 1, EFFECTS)
    cases = [case for pair in zip(clean, hidden, strict=True) for case in pair][:count]
    lines = []
    for number, made in enumerate(make_recordings(vehicle, cases, SECONDS)):
        if number < first:
            continue
        random, kind = np.random.default_rng([seed, number]), KINDS[number // 2 % len(KINDS)]
        wrong = falsified(system, in_order(system, made.values), kind, random)
        began = time.process_time()
        report = diagnose(system, wrong, Options(file=f"{kind}-{number}"))
        faults = {name for f in report.findings if f.kind is EffectKind.FAULT for name in f.location.split("|")}
        if kind == CLOCK:  # an ordinary drift is told as a note
            faults |= {name for note in report.advice if "clock" in note for name in wrong.channels if name in note}
        physics = {(f.location, f.effect) for f in report.findings if f.kind is not EffectKind.FAULT}
        truth = {(f["location"], f["effect"]) for f in made.case.findings()}
        line = {
            "number": number,
            "error": kind,
            "channels": sorted(wrong.channels),
            "snr": made.snr,
            "truth": sorted(truth),
            "verdict": report.verdict,
            "said": [[f.location, f.effect] for f in report.findings],
            "sensor": faults == wrong.channels,
            "physics": physics == truth,
            "blamed": bool({place for place, _ in physics} - {place for place, _ in truth}),
            "cpu_seconds": round(time.process_time() - began, 1),
        }
        lines.append(line)
        yield line
    yield {
        "recordings": len(lines),
        "sensor": float(np.mean([line["sensor"] for line in lines])),
        "physics": float(np.mean([line["physics"] for line in lines])),
        "blamed": sum(bool(line["blamed"]) for line in lines),
    }


def falsified(system: System, clean: Array, kind: str, random: np.random.Generator) -> FalsifiedRecording:
    """A recording with an error of a kind."""
    values, names = clean.copy(), [channel.name for channel in system.channels]
    if kind == CLOCK:
        body = str(random.choice(list(system.bodies)))
        node = sensors_on(system, body)
        at = [names.index(name) for name in node]
        values[:, at] = later(clean[:, at], float(random.choice([-1, 1]) * random.uniform(3e-5, 1.5e-4)))
        return FalsifiedRecording(kind, frozenset(node), values)
    name, source = (str(one) for one in random.choice(list(system.sensors), 2, replace=False))
    values[:, names.index(name)] = ERRORS[kind](clean[:, names.index(name)], clean[:, names.index(source)], random)
    return FalsifiedRecording(kind, frozenset([name]), values)


def later(series: Array, rate: float) -> Array:
    """Columns (T, m) that become later at a rate, right in the middle: sums of sinc functions of near samples."""
    time = np.arange(len(series), dtype=float)
    wanted, reach = time - rate * (time - len(time) / 2), 32
    nearest = np.round(wanted).astype(int)
    found = np.zeros_like(series)
    for step in range(-reach, reach + 1):
        at = np.clip(nearest + step, 0, len(series) - 1)
        off = wanted - (nearest + step)
        found += (np.sinc(off) * np.cos(np.pi * off / (2 * reach + 2)) ** 2)[:, None] * series[at]
    return found
