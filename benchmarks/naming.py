"""`sprung bench naming [--seed 1] [--laws a,b] [--motions sine,quake]`: component tests of what real rigs do.

Forces of one element along a measured motion, integrated here with steps of their own: laws of the catalogue, with
parameters drawn anew, and rigs that no law of it describes.  Each under a sine, a sweep, random motion and one like an
earthquake's, with noise and quantisation as of a test bench.  Counted as

    right     only what is there was named (or a look-alike that predicts another amplitude as well)
    unknown   `unknown_physics`, or a family that holds the truth
    wrong     something else named with p < 1e-3
    missed    `consistent` although something is left (a false all-clear)
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, chirp, sosfiltfilt

from sprung.benchmarks.naming_rigs import RIGS, TRAVEL, RigKind
from sprung.model.diagnosis.api import DiagnosisError, Options, Report, diagnose
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.diagnosis.report.report import Finding
from sprung.model.laws import ElementLaw, SpringDamper, find_law
from sprung.model.laws.along import force_along
from sprung.model.system import System, parse_system

Array = NDArray[np.float64]
RATE, SECONDS, FINER = 200.0, 20.0, 16
MOTIONS = ("sine", "sweep", "random", "quake")
ANOTHER = 0.6  # times the amplitude, at which a look-alike has to predict as well
AS_WELL = 2.0  # times its own error: chance, and shapes that a smaller motion shows otherwise
CHANCE = 1e-3


@dataclass(frozen=True)
class BenchTest:
    """Columns of one test."""

    values: Array
    sample_rate: float = RATE
    lost: int = 0


def run(seed: int = 1, laws: str = "", motions: str = ",".join(MOTIONS)) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, and the counts."""
    for given, known in ((laws, RIGS), (motions, MOTIONS)):
        if unknown := [word for word in given.split(",") if given and word not in known]:
            raise ValueError(f"bench naming: no {unknown[0]!r}; known are {', '.join(known)}")
    counts: dict[str, int] = dict.fromkeys(("right", "unknown", "wrong", "missed", "refused"), 0)
    for index, (name, rig) in enumerate(RIGS.items()):
        if laws and name not in laws.split(","):
            continue
        for number, motion in enumerate(MOTIONS):
            if motion not in motions.split(","):
                continue
            began = time.process_time()
            line = {"law": name, "motion": motion} | judged(rig, motion, [seed, index, number])
            counts[line["judged"]] += 1
            yield line | {"cpu_seconds": round(time.process_time() - began, 1)}
    yield counts


def judged(rig: RigKind, motion: str, seed: list[int]) -> dict[str, Any]:
    """One recording, and what came of it."""
    random = np.random.default_rng(seed)
    drawn = int(random.integers(2**31))
    d = moved(motion, random)
    signal = levels(random)
    record = measured(d, forces(rig, d, drawn, signal), signal if rig.signal else None, random)
    try:
        report = diagnose(SIGNALLED if rig.signal else BENCH, record, Options(file=motion))
    except DiagnosisError as refused:
        return {"judged": "refused", "said": str(refused)}
    found = [f for f in report.findings if f.kind is not EffectKind.NUISANCE]
    line: dict[str, Any] = {
        "verdict": report.verdict,
        "said": {f.effect: {p.name: [p.value, p.std] for p in (*f.parameters, *f.quoted)} for f in found},
        "held_out_before": report.baseline_validation.nrmse,
        "held_out": report.augmented_validation.nrmse,
        "floor": report.noise_floor.nrmse,
    }
    if report.verdict == "consistent":
        return line | {"judged": "missed" if report.unexplained.share > 0 or rig.named else "right"}
    if report.verdict == "unknown_physics":
        return line | {"judged": "unknown"}
    line["values"] = beside_truth(rig, drawn, found, 0.5 * float(d.max() + d.min()))
    families = [set((f.family or f.effect).split(" or ")) for f in found if f.p_value is None or f.p_value < CHANCE]
    if all(family & rig.named for family in families):
        return line | {"judged": "right"}
    if rig.hysteretic and not rig.signal:
        other = ANOTHER * moved(motion, np.random.default_rng([*seed, 1]))
        error = predicted(report, other, forces(rig, other, drawn, signal))
        line["error_at_another_amplitude"] = error
        if error < AS_WELL * max(report.augmented_validation.nrmse, report.noise_floor.nrmse):
            return line | {"judged": "right"}
    return line | {"judged": "wrong"}


def beside_truth(rig: RigKind, drawn: int, findings: list[Finding], middle: float) -> dict[str, list[float]]:
    """True value, value and deviation of what a finding of the true law quotes; laws that follow a signal have none.

    middle: of the travel, m, from which a report counts how far a stop is.
    """
    if rig.signal:
        return {}
    random = np.random.default_rng(drawn)
    _linear(random)
    shown = {"gap": -middle, "gap_compression": middle}
    truth = {name: value + shown.get(name, 0.0) for name, value in rig.made(random).truth.items()}
    said = {p.name: p for f in findings if f.effect in rig.named for p in (*f.parameters, *f.quoted)}
    return {name: [value, said[name].value, said[name].std] for name, value in truth.items() if name in said}


def predicted(report: Report, deflection: Array, force: Array) -> float:
    """Error of a report's model along another motion, rms over the force's deviation; a constant is free."""
    value = {p.name.split(".")[1]: p.value for p in report.augmented}
    element = SpringDamper(value["stiffness"], value["damping"])
    motion = element_motion(deflection, None, RATE)
    found = element.stiffness * motion.deflection + element.damping * motion.rate
    for law in report.laws:
        known = find_law(law.effect)
        if isinstance(known, ElementLaw) and law.effect != "preload":
            wide = known if len(known.parameters) == len(law.parameters) or known.wider is None else known.wider
            values = tuple(p.value for p in law.parameters)
            found = found + force_along(wide, values, motion.deflection, motion.rate, motion.time, element)
    return float(np.std(force - found) / np.std(force))


def forces(rig: RigKind, deflection: Array, drawn: int, signal: Array) -> Array:
    """True force of spring, damper and rig along a motion, N; the rig's numbers come of `drawn`."""
    random = np.random.default_rng(drawn)
    k, c, preload = _linear(random)
    step = rig.made(random).step
    fine = CubicSpline(np.arange(len(deflection)), deflection)(np.arange((len(deflection) - 1) * FINER + 1) / FINER)
    h = 1 / (RATE * FINER)
    rate = np.gradient(fine, h)
    found = np.array([step(x, v, h) for x, v in zip(fine.tolist(), rate.tolist(), strict=True)])[::FINER]
    linear = preload + k * deflection + c * rate[::FINER]
    total: Array = linear + (signal * found if rig.signal else found)
    return total


def _linear(random: np.random.Generator) -> tuple[float, float, float]:
    """Spring, N/m, damper, N s/m, and preload, N."""
    return random.uniform(1e4, 4e4), random.uniform(400, 1500), random.uniform(-200, 200)


def measured(deflection: Array, force: Array, signal: Array | None, random: np.random.Generator) -> BenchTest:
    """As a test bench records it: noise of 10 um and of a 300th of the force, both quantised."""
    noise = 3e-3 * float(np.std(force))
    shown = np.round((deflection + 1e-5 * random.standard_normal(len(deflection))) / 2e-6) * 2e-6
    cell = np.round((force + noise * random.standard_normal(len(force))) / (noise / 2)) * (noise / 2)
    return BenchTest(np.column_stack([shown, cell] if signal is None else [shown, cell, signal]))


def moved(motion: str, random: np.random.Generator) -> Array:
    """Deflections of a test, m."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    begin = np.clip(t, 0.0, 1.0)
    if motion == "sine":
        return TRAVEL * begin * np.sin(2 * np.pi * random.uniform(0.6, 1.5) * t)
    if motion == "sweep":
        return np.asarray(TRAVEL * begin * chirp(t, 0.3, t[-1], random.uniform(4, 6), phi=-90))
    high = 5.0 if motion == "random" else 3.0
    band = butter(3, [0.2, high], "bandpass", fs=RATE, output="sos")
    noise = sosfiltfilt(band, random.standard_normal(len(t) + 4000))[2000:-2000]
    if motion == "quake":
        noise = noise * np.interp(t / t[-1], [0.0, 0.1, 0.3, 1.0], [0.0, 1.0, 1.0, 0.15])
    return np.asarray(TRAVEL * noise / np.max(np.abs(noise)))


def levels(random: np.random.Generator) -> Array:
    """A current or voltage that is switched every 1.3 s, about 1."""
    held = random.uniform(0.3, 1.7, int(SECONDS / 1.3) + 2)
    return np.asarray(held[(np.arange(int(SECONDS * RATE)) / RATE / 1.3).astype(int)])


def _bench(more: str, tail: str) -> System:
    return parse_system(f"""
name: test bench
sample_rate: {RATE:g}
window: 64
inputs: {{rod: {{kind: displacement, displacement: {{csv: d, noise: 1e-5}}}}}}
elements: {{damper: {{upper: rod, lower: ground, stiffness: 1e4, damping: 1e3{more}}}}}
sensors: {{cell: {{kind: force, element: damper, csv: F, noise: 1.0}}}}
{tail}""")


BENCH = _bench("", "")
SIGNALLED = _bench(", depends_on: [valve]", "signals: {valve: {csv: u, unit: A}}")
