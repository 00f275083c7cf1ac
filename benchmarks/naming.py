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

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, chirp, sosfiltfilt

from sprung.model.diagnosis.api import DiagnosisError, Options, Report, diagnose
from sprung.model.diagnosis.component.motion import element_motion
from sprung.model.diagnosis.report.report import Finding
from sprung.model.laws import ElementLaw, SpringDamper, find_law
from sprung.model.laws.along import force_along
from sprung.model.system import System, parse_system

Array = NDArray[np.float64]
Stepped = Callable[[float, float, float], float]  # deflection m, rate m/s, step s -> force N; keeps its memory
RATE, SECONDS, FINER = 200.0, 20.0, 16
TRAVEL = 0.02  # m
MOTIONS = ("sine", "sweep", "random", "quake")
ANOTHER = 0.6  # times the amplitude, at which a look-alike has to predict as well
AS_WELL = 2.0  # times its own error: chance, and shapes that a smaller motion shows otherwise
CHANCE = 1e-3


@dataclass(frozen=True)
class SimulatedRig:
    """A component with its memory, and its true values by the names that a report has for them."""

    step: Stepped
    truth: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RigKind:
    """One simulated component beside a spring and a damper."""

    named: frozenset[str]  # effects that are right; empty: nothing is there
    made: Callable[[np.random.Generator], SimulatedRig]
    signal: bool = False  # follows a measured signal
    hysteretic: bool = False  # the same loop has several names


@dataclass(frozen=True)
class BenchTest:
    """Columns of one test."""

    values: Array
    sample_rate: float = RATE
    lost: int = 0


def run(seed: int = 1, laws: str = "", motions: str = ",".join(MOTIONS)) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, and the counts."""
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
    found = [f for f in report.findings if f.effect != "preload"]
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
    line["values"] = beside_truth(rig, drawn, found)
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


def beside_truth(rig: RigKind, drawn: int, findings: list[Finding]) -> dict[str, list[float]]:
    """True value, value and deviation of what a finding of the true law quotes; laws that follow a signal have none."""
    if rig.signal:
        return {}
    random = np.random.default_rng(drawn)
    _linear(random)
    truth = rig.made(random).truth
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


# --- laws of the catalogue ---------------------------------------------------------------------------------------


def _sign(rate: float, smoothing: float = 5e-4) -> float:
    return math.tanh(rate / smoothing)


def _nothing(random: np.random.Generator) -> SimulatedRig:
    return SimulatedRig(lambda x, v, h: 0.0)


def _coulomb(random: np.random.Generator) -> SimulatedRig:
    force = random.uniform(60, 300)
    return SimulatedRig(lambda x, v, h: force * _sign(v), {"breakaway_force": force})


def _stribeck(random: np.random.Generator) -> SimulatedRig:
    force, static, fall = random.uniform(60, 200), random.uniform(1.5, 2.2), random.uniform(0.01, 0.04)
    return SimulatedRig(
        lambda x, v, h: force * (1 + (static - 1) * math.exp(-((v / fall) ** 2))) * _sign(v),
        {"force": force, "static_force": static * force, "stribeck_rate": fall},
    )


def _moved() -> Callable[[float], float]:
    """How far a deflection has come since the last step: a memory follows the way, not the rate at a step's end."""
    last: float | None = None

    def since(x: float) -> float:
        nonlocal last
        way = 0.0 if last is None else x - last
        last = x
        return way

    return since


def _presliding(random: np.random.Generator, excess: tuple[float, float]) -> SimulatedRig:
    force, reach, fall = random.uniform(80, 300), random.uniform(2e-4, 1e-3), random.uniform(0.02, 0.05)
    static = force * (1 + random.uniform(*excess))
    stiffness, z, moved = force / reach, 0.0, _moved()

    def step(x: float, v: float, h: float) -> float:
        nonlocal z
        way = moved(x)
        limit = (force + (static - force) * math.exp(-((way / h / fall) ** 2))) / stiffness
        target = math.copysign(limit, way)
        z = target + (z - target) * math.exp(-abs(way) / limit)
        return stiffness * z

    return SimulatedRig(step, {"yield_force": force, "yield_displacement": reach})


def _bouc_wen(random: np.random.Generator) -> SimulatedRig:
    force, reach, n = random.uniform(100, 500), random.uniform(5e-4, 2e-3), random.uniform(1.0, 2.0)
    z, moved = 0.0, _moved()  # of the yield displacement

    def grows(z: float, way: float) -> float:
        rounded: float = abs(z) ** (n - 1) * (0.7 * abs(way) * z + 0.3 * way * abs(z))
        return (way - rounded) / reach

    def step(x: float, v: float, h: float) -> float:
        nonlocal z
        way = moved(x)
        first = grows(z, way)
        z += 0.5 * (first + grows(z + first, way))
        return force * z

    return SimulatedRig(step, {"yield_force": force, "yield_displacement": reach})


def _slider(gap: float, stiffness: float, slip: float) -> Stepped:
    """A slider of a slip force behind a spring and a gap."""
    u, last = 0.0, 0.0
    most = 0.5 * gap + slip / stiffness

    def step(x: float, v: float, h: float) -> float:
        nonlocal u, last
        u = min(max(u + x - last, -most), most)
        last = x
        return stiffness * math.copysign(max(abs(u) - 0.5 * gap, 0.0), u)

    return step


def _backlash(random: np.random.Generator) -> SimulatedRig:
    gap, stiffness, slip = random.uniform(3e-3, 8e-3), random.uniform(3e5, 1e6), random.uniform(500, 1500)
    return SimulatedRig(_slider(gap, stiffness, slip), {"slip_force": slip, "lost_motion": gap})


def _pinched(random: np.random.Generator) -> SimulatedRig:
    force, width, depth = random.uniform(300, 800), random.uniform(2e-3, 5e-3), random.uniform(0.4, 0.8)
    slider = _slider(0.0, force / random.uniform(5e-4, 2e-3), force)
    return SimulatedRig(lambda x, v, h: slider(x, v, h) * (1 - depth * math.exp(-((x / width) ** 2))))


def _gas_spring(random: np.random.Generator) -> SimulatedRig:
    force, length = random.uniform(300, 900), TRAVEL * random.uniform(1.6, 3.0)
    return SimulatedRig(lambda x, v, h: force * (1 - (1 + x / length) ** -1.3))


def _valve(random: np.random.Generator) -> SimulatedRig:
    knee, share, c = random.uniform(0.03, 0.06), random.uniform(0.1, 0.3), random.uniform(1500, 3000)
    return SimulatedRig(
        lambda x, v, h: c * math.copysign(min(abs(v), knee) + share * max(abs(v) - knee, 0.0), v), {"knee": knee}
    )


# --- what no law of the catalogue is -----------------------------------------------------------------------------


def _magneto_rheological(random: np.random.Generator) -> SimulatedRig:
    """Kwok et al. (2006): a tanh of rate and sign of the deflection."""
    force, slope, wide = random.uniform(100, 300), random.uniform(15, 40), random.uniform(0.4, 0.9)
    return SimulatedRig(lambda x, v, h: force * math.tanh(slope * v + wide * math.copysign(1.0, x)))


def _menegotto_pinto(random: np.random.Generator) -> SimulatedRig:
    """Steel (Giuffre, Menegotto and Pinto): branches between asymptotes, rounder after the first reversal."""
    k, slip, b, r = random.uniform(2e5, 5e5), random.uniform(500, 1500), random.uniform(0.02, 0.06), 18.0
    reach = slip / k
    x0 = f0 = last_x = last_f = 0.0
    x1, f1, way = reach, slip, 0

    def step(x: float, v: float, h: float) -> float:
        nonlocal x0, f0, x1, f1, way, r, last_x, last_f
        moved = x - last_x
        if moved and (way == 0 or moved * way < 0):
            first, way = way == 0, 1 if moved > 0 else -1
            x0, f0 = last_x, last_f
            if not first:
                r = 3.0
            line = way * slip * (1 - b)
            x1 = (line - f0 + k * x0) / (k - b * k)
            f1 = line + b * k * x1
        e = (x - x0) / (x1 - x0)
        rounded: float = e / (1 + abs(e) ** r) ** (1 / r)
        last_x, last_f = x, f0 + (f1 - f0) * (b * e + (1 - b) * rounded)
        return last_f

    return SimulatedRig(step)


def _self_centring(random: np.random.Generator) -> SimulatedRig:
    """A flag-shaped loop, as of shape-memory alloys: loading and unloading plateaus on each side."""
    k, reach, share = random.uniform(2e5, 4e5), random.uniform(2e-3, 4e-3), random.uniform(0.3, 0.6)
    force = last = 0.0

    def step(x: float, v: float, h: float) -> float:
        nonlocal force, last
        force, last = force + k * (x - last), x
        size, way = abs(x), math.copysign(1.0, x)
        upper = min(k * size, k * reach + 0.05 * k * (size - reach)) if size > 0 else 0.0
        lower = min(k * size, share * k * reach + 0.05 * k * (size - share * reach))
        force = way * min(max(way * force, lower), upper)
        return force

    return SimulatedRig(step)


def _rubber(random: np.random.Generator) -> SimulatedRig:
    """Berg's friction with branches of relaxation over four decades, as of a fractional derivative."""
    slip, half = random.uniform(60, 150), random.uniform(4e-4, 1e-3)
    rates, strengths = np.geomspace(1e-2, 10, 7), random.uniform(4e3, 8e3) * np.ones(7)
    branch, xs, fs, force, last, way = np.zeros(7), 0.0, 0.0, 0.0, 0.0, 0.0

    def step(x: float, v: float, h: float) -> float:
        nonlocal branch, xs, fs, force, last, way
        moved = x - last
        last = x
        if moved * way < 0:
            xs, fs = x - moved, force
        way = moved or way
        y, a = x - xs, fs / slip
        if y > 0:
            force = fs + y * (slip - fs) / (half * (1 - a) + y)
        elif y < 0:
            force = fs + y * (slip + fs) / (half * (1 + a) - y)
        branch = (branch + strengths * moved) * np.exp(-h * 2 * np.pi * rates)
        return force + float(branch.sum())

    return SimulatedRig(step)


def _oil(random: np.random.Generator) -> SimulatedRig:
    """Relief valves of different settings, compressible oil, and a chamber that cavitates in compression."""
    c, after = random.uniform(8e3, 2e4), random.uniform(0.05, 0.15)
    relief, other, stiff, least = random.uniform(600, 1200), random.uniform(300, 600), 2e6, 1.4
    force = 0.0

    def step(x: float, v: float, h: float) -> float:
        nonlocal force
        opens = relief if force > 0 else other
        flow = force / c + math.copysign(max(abs(force) - opens, 0.0) / (after * c), force)
        force = max(force + h * stiff * (v - flow), -least * other)
        return force

    return SimulatedRig(step)


_FRICTION = frozenset({"coulomb_friction", "stribeck", "dahl", "lugre"})
_HYSTERESIS = frozenset({"bouc_wen", "dahl", "lugre"})
_ANY = _FRICTION | _HYSTERESIS
RIGS: dict[str, RigKind] = {
    "nothing": RigKind(frozenset(), _nothing),
    "coulomb": RigKind(frozenset({"coulomb_friction"}), _coulomb, hysteretic=True),
    "stribeck": RigKind(frozenset({"stribeck"}), _stribeck, hysteretic=True),
    "dahl": RigKind(frozenset({"dahl"}), lambda random: _presliding(random, (0.0, 0.0)), hysteretic=True),
    "lugre": RigKind(frozenset({"lugre"}), lambda random: _presliding(random, (0.4, 1.0)), hysteretic=True),
    "bouc_wen": RigKind(frozenset({"bouc_wen"}), _bouc_wen, hysteretic=True),
    "friction_backlash": RigKind(frozenset({"friction_backlash"}), _backlash, hysteretic=True),
    "pinched_hysteresis": RigKind(frozenset({"pinched_hysteresis"}), _pinched, hysteretic=True),
    "gas_spring": RigKind(frozenset({"gas_spring"}), _gas_spring),
    "damper_blowoff": RigKind(frozenset({"damper_blowoff"}), _valve),
    "friction by current": RigKind(frozenset({"coulomb_friction"}), _coulomb, signal=True, hysteretic=True),
    "hysteresis by current": RigKind(frozenset({"bouc_wen"}), _bouc_wen, signal=True, hysteretic=True),
    "magneto-rheological after Kwok": RigKind(_ANY, _magneto_rheological, hysteretic=True),
    "steel after Menegotto and Pinto": RigKind(frozenset({"bouc_wen"}), _menegotto_pinto, hysteretic=True),
    "self-centring": RigKind(frozenset(), _self_centring, hysteretic=True),
    "rubber after Berg": RigKind(_HYSTERESIS | {"series_stiffness"}, _rubber, hysteretic=True),
    "oil that cavitates": RigKind(frozenset({"damper_blowoff", "bouc_wen", "series_stiffness"}), _oil),
}
