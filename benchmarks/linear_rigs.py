"""`sprung bench linear-rigs [--count 16] [--seed 1]`: linear rigs whose instruments and system file are as usual ones.

Chains of one to three bodies on a shaker whose force is measured, with damping down to half a per cent of critical.
Stiffnesses of the system file are off by up to 35 %, dampings by up to 80 %, masses by a per cent, gains of all
channels by half a per cent.  Excited by noise, a logarithmic sweep, a hammer or steps; accelerations or displacements
are measured.  Nothing is wrong but values, so that every law that is named is a false one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, chirp, lsim, sosfiltfilt

from sprung.benchmarks.shaken import ShakenRig
from sprung.model.diagnosis.api import DiagnosisError, diagnose
from sprung.model.system import parse_system

Array = NDArray[np.float64]
RATE, FINER, SECONDS = 200.0, 20, 24.0
FORCE_NOISE = 0.05  # N
NOISE = {"acceleration": 0.005, "displacement": 1e-6}  # m/s^2, m
STIFFNESS_OFF, DAMPING_OFF, MASS_OFF, GAIN_OFF = 0.3, 0.6, 0.01, 0.005  # natural logarithms
SIGMAS = 3.0  # stated deviations within which values are right


def _noise(t: Array, random: np.random.Generator) -> Array:
    band = butter(2, [1.0, 35.0], "bandpass", fs=RATE * FINER, output="sos")
    force = sosfiltfilt(band, random.standard_normal(len(t)))
    return np.asarray(50.0 * force / np.std(force))


def _sweep(t: Array, random: np.random.Generator) -> Array:
    return np.asarray(50.0 * chirp(t, 1.0, SECONDS, 30.0, method="logarithmic") * np.minimum(1.0, 2 * t))


def _hammer(t: Array, random: np.random.Generator) -> Array:
    blows = np.arange(1.0, SECONDS - 3.0, 4.3)
    sizes = 600.0 * random.uniform(0.6, 1.4, len(blows))
    return np.asarray(sum(size * np.exp(-(((t - at) / 0.004) ** 2)) for at, size in zip(blows, sizes, strict=True)))


def _steps(t: Array, random: np.random.Generator) -> Array:
    levels = np.select([t > 16, t > 9, t > 2], [0.0, -40.0, 80.0], 0.0)
    return np.asarray(sosfiltfilt(butter(2, 30.0, fs=RATE * FINER, output="sos"), levels))


EXCITATIONS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "noise": _noise,
    "sweep": _sweep,
    "hammer": _hammer,
    "steps": _steps,
}


def run(count: int = 16, seed: int = 1, excitations: str = "") -> Iterator[dict[str, Any]]:
    """Yields one line per excitation and measured quantity.

    count: rigs of each; excitations: some of noise, sweep, hammer and steps, between commas.
    """
    for excitation in excitations.split(",") if excitations else EXCITATIONS:
        for quantity in NOISE:
            began = time.process_time()
            verdicts, named, beyond = [], [], 0
            for number in range(count):
                rig, true = made(excitation, quantity, np.random.default_rng([seed, number]))
                try:
                    report = diagnose(rig.system, rig)
                except DiagnosisError as refused:
                    verdicts.append(f"refused: {refused}")
                    continue
                verdicts.append(report.verdict)
                named += [[number, found.location, found.effect] for found in report.findings]
                beyond += sum(abs(one.value - true[one.name]) > SIGMAS * one.std for one in report.augmented)
            yield {
                "excitation": excitation,
                "measured": quantity,
                "rigs": count,
                "verdicts": {verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))},
                "named": named,
                "values_beyond": beyond,
                "cpu_seconds": round(time.process_time() - began, 1),
            }


def made(excitation: str, quantity: str, random: np.random.Generator) -> tuple[ShakenRig, dict[str, float]]:
    """A rig with its recording, and the true values by the names of its parameters."""
    bodies = int(random.integers(1, 4))
    mass = 10 * random.uniform(0.3, 1.5, bodies)
    frequency, damped = random.uniform(4, 12), random.uniform(0.004, 0.05)
    k = 10 * (2 * np.pi * frequency) ** 2 * random.uniform(0.5, 2, bodies)
    c = 2 * damped * k / (2 * np.pi * frequency)
    driven = int(random.integers(0, bodies))
    t = np.arange(int(SECONDS * RATE) * FINER) / (RATE * FINER)
    force = EXCITATIONS[excitation](t, random)
    A = np.block(
        [[np.zeros((bodies, bodies)), np.eye(bodies)], [-_chain(k) / mass[:, None], -_chain(c) / mass[:, None]]]
    )
    B = np.zeros((2 * bodies, 1))
    B[bodies + driven] = 1 / mass[driven]
    rows, direct = (
        (A[bodies:], B[bodies:]) if quantity == "acceleration" else (np.eye(bodies, 2 * bodies), 0 * B[bodies:])
    )
    _, shown, _ = lsim((A, B, rows, direct), force, t)
    low = butter(8, 0.4 * RATE, fs=RATE * FINER, output="sos")
    seen = sosfiltfilt(low, np.column_stack([force, shown]), axis=0)[::FINER]
    seen *= np.exp(GAIN_OFF * random.standard_normal(bodies + 1))
    seen += np.array([FORCE_NOISE, *[NOISE[quantity]] * bodies]) * random.standard_normal(seen.shape)
    stated = mass * np.exp(MASS_OFF * random.standard_normal(bodies))
    stiffness = k * np.exp(STIFFNESS_OFF * random.uniform(-1, 1, bodies))
    damping = c * np.exp(DAMPING_OFF * random.uniform(-1, 1, bodies))
    true = {f"k{i}.stiffness": float(k[i]) for i in range(bodies)} | {
        f"k{i}.damping": float(c[i]) for i in range(bodies)
    }
    return ShakenRig(parse_system(_file(stated, stiffness, damping, driven, quantity)), seen, RATE), true


def _chain(values: Array) -> Array:
    """Matrix of a chain from the ground of springs or dampers (n,), (n, n)."""
    steps = np.eye(len(values)) - np.eye(len(values), k=-1)
    return np.asarray(steps.T @ (values[:, None] * steps))


def _file(mass: Array, k: Array, c: Array, driven: int, quantity: str) -> str:
    """The system file of a chain."""
    names = range(len(mass))
    return "\n".join(
        [
            f"name: chain\nsample_rate: {RATE:.0f}\nwindow: {2 * RATE:.0f}\nbodies:",
            *(f"  m{i}: {{mass: {mass[i]}}}" for i in names),
            f"inputs:\n  shaker: {{kind: force, body: m{driven}, csv: force, noise: {FORCE_NOISE}}}\nelements:",
            *(
                f"  k{i}: {{upper: m{i}, lower: {f'm{i - 1}' if i else 'ground'}, stiffness: {k[i]}, damping: {c[i]}}}"
                for i in names
            ),
            "sensors:",
            *(f"  a{i}: {{kind: {quantity}, body: m{i}, csv: a{i}, noise: {NOISE[quantity]}}}" for i in names),
        ]
    )
