"""`sprung bench open-catalogue [--count 60] [--seed 1]`: concealed laws that no catalogue has, reported as formulas.

A quarter car with a force at its spring that is drawn from a grammar of deflection, rate and one hidden state: a shape
or the sum of two, its own lengths, rates and times at random.  The truth is integrated here (Runge-Kutta at 1 kHz),
without code of the product.  Counted are recordings whose signal-to-noise ratio, for a test that knows the law, is
three times its limit or more.

The error of a formula is that of the element's whole force, k d + c v included, over the rms of what spring and damper
cannot imitate of the concealed one: along the part of the motion that no fit saw, and along another ride at 1.5 times
the amplitude.  A formula is equivalent where these are at most 5 % and 15 %, and false where the first exceeds 15 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.signal import firwin, lfilter, oaconvolve

from sprung.benchmarks.generator.draw import Case
from sprung.benchmarks.generator.oracle import oracle_snr
from sprung.benchmarks.generator.vehicle import vehicle_of
from sprung.benchmarks.structure import LIMIT, MadeSamples
from sprung.model.diagnosis.api import Finding, Options, diagnose
from sprung.model.diagnosis.report.report import Report
from sprung.model.system import parse_system

Array = NDArray[np.float64]
VISIBLE = 3.0  # limits
GOOD, GOOD_BEYOND, FALSE = 0.05, 0.15, 0.15  # errors of a formula
FINE = 10  # steps per sample
FARTHEST = 10.0  # of the usual deflection: a law that lets the body go further is none
SYSTEM = """
name: quarter-car
sample_rate: 100
window: 100
bodies:
  car: {mass: 8000}
  bogie: {mass: 1300}
inputs:
  wheel:
    kind: support
    displacement: {csv: d, noise: 1.0e-5}
    velocity: {csv: v, noise: 5.0e-4}
elements:
  primary: {upper: bogie, lower: wheel, stiffness: 2.4e+6, damping: 1.0e+4}
  secondary: {upper: car, lower: bogie, stiffness: 4.3e+5, damping: 2.0e+4}
sensors:
  car_a: {kind: acceleration, body: car, noise: 0.004, csv: a}
  car_b: {kind: acceleration, body: car, noise: 0.004, csv: b}
  bogie_a: {kind: acceleration, body: bogie, noise: 0.03, csv: e}
  bogie_b: {kind: acceleration, body: bogie, noise: 0.03, csv: f}
"""
SHAPES = (  # over deflection and rate in units of their usual size x, y, and a hidden state w in that of x
    *("x * abs(y)", "abs(x) * y", "x**2 * y", "x * y**2", "x * y", "x**2", "x * abs(x)", "x**2 * abs(y)"),
    *("sin(x / P)", "tanh(x / P)", "max(x - P, 0)", "max(-x - P, 0)", "max(-x - P, 0)**2", "x * exp(-(y / P)**2)"),
    *("y * exp(-(x / P)**2)", "abs(x) * tanh(y / P)", "max(y - P, 0)", "x / (1 + (x / P)**2)", "exp(x / (3 * P)) - 1"),
    *("w * abs(w)", "w**2", "x * w", "w**3"),
)
USUAL = (2.5e-3, 0.026)  # m and m/s


@dataclass(frozen=True)
class OpenLaw:
    """A concealed force: F(d, v, z) with z' = v - z / time."""

    text: str
    force: Callable[[Any, Any, Any], Any]
    time: float


def run(count: int = 60, seed: int = 1, seconds: float = 40.0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording and the rates."""
    totals = {"visible": 0, "formula": 0, "equivalent": 0, "false": 0, "other_name": 0, "missed": 0}
    within: list[float] = []
    for number in range(count):
        random = np.random.default_rng([seed, number])
        line = _one(random, number, seconds)
        yield line
        if line["limits"] >= VISIBLE:
            totals["visible"] += 1
            for key in ("formula", "equivalent", "false", "other_name", "missed"):
                totals[key] += bool(line[key])
            within += [line["errors"][0]] if line["errors"] else []
    median = float(np.median(within)) if within else None
    yield {"recordings": count, **totals, "median_error": median}


def _one(random: np.random.Generator, number: int, seconds: float) -> dict[str, Any]:
    law, values, ((clean, motion), (_, beyond)) = ridden(random, seconds)
    data = yaml.safe_load(SYSTEM)
    truth = {q: {"primary": values[q][0], "secondary": values[q][1]} for q in ("stiffness", "damping")}
    case = Case("open", 0, truth["stiffness"], truth["damping"], 45.0, 0.0, None)
    snr = oracle_snr(vehicle_of(data), case, clean, clean) or 0.0
    noise = np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2])
    record = MadeSamples(clean + noise * random.standard_normal(clean.shape))
    began = time.process_time()
    report = diagnose(parse_system(SYSTEM), record, Options(file=f"open-{number}"))
    formula = next((f for f in report.findings if f.effect == "formula"), None)
    errors = [] if formula is None else errors_of(report, formula, law, values, (motion, beyond))
    return {
        "number": number,
        "truth": law.text,
        "limits": round(snr / LIMIT, 1),
        "verdict": report.verdict,
        "said": [[f.location, f.effect, f.formula] for f in report.findings],
        "errors": [float(f"{e:.3g}") for e in errors],
        "formula": formula is not None,
        "equivalent": bool(errors) and errors[0] <= GOOD and errors[1] <= GOOD_BEYOND,
        "false": bool(errors) and errors[0] > FALSE,
        "other_name": any(f.effect not in ("formula", "unknown") for f in report.findings),
        "missed": not report.findings,
        "cpu_seconds": round(time.process_time() - began, 1),
    }


def ridden(random: np.random.Generator, seconds: float) -> tuple[OpenLaw, dict[str, Array], list[tuple[Array, Array]]]:
    """A law and a vehicle that it leaves stable, with rides at the usual and at 1.5 times the amplitude."""
    while True:
        law, values = drawn(random), elements(random)
        roads = [(int(random.integers(2**31)), level) for level in (1.5, 1.0)]
        try:
            rides = [simulated(law, values, seconds, road, level) for road, level in roads]
        except (OverflowError, ValueError):  # it flies away
            continue
        if all(np.isfinite(motion).all() and np.std(motion[:, 0]) < FARTHEST * USUAL[0] for _, motion in rides):
            return law, values, rides[::-1]


def drawn(random: np.random.Generator) -> OpenLaw:
    """A shape, or the sum of two, of the size of a tenth to a half of the spring's force."""
    terms = []
    for shape in random.choice(SHAPES, 1 if random.random() < 0.7 else 2, replace=False):
        size = float(random.choice([-1, 1]) * np.exp(random.uniform(np.log(60.0), np.log(500.0))))
        if shape.startswith(("max(-", "exp(x")):
            size = -abs(size) if shape.startswith("max(-") else abs(size)
        terms.append(f"{size:.4g} * ({shape.replace('P', f'{random.uniform(0.4, 1.6):.3g}')})")
    text, duration = " + ".join(terms), float(np.exp(random.uniform(np.log(0.03), np.log(0.3))))
    arrays = {"sin": np.sin, "tanh": np.tanh, "exp": np.exp, "abs": np.abs, "max": np.maximum}
    numbers = {"sin": math.sin, "tanh": math.tanh, "exp": math.exp, "abs": abs, "max": max}
    code = compile(text, "law", "eval")

    def force(d: Any, v: Any, z: Any) -> Any:
        names = numbers if isinstance(d, float) else arrays
        return eval(code, names, {"x": d / USUAL[0], "y": v / USUAL[1], "w": z / USUAL[0]})

    return OpenLaw(f"{text}, T = {duration:.3g} s" if "w" in text else text, force, duration)


def elements(random: np.random.Generator) -> dict[str, Array]:
    """Stiffness and damping of primary and secondary."""
    nominal = {"stiffness": np.array([2.4e6, 4.3e5]), "damping": np.array([1.0e4, 2.0e4])}
    return {name: value * random.uniform(0.85, 1.15, 2) for name, value in nominal.items()}


def simulated(law: OpenLaw, values: dict[str, Array], seconds: float, road: int, level: float) -> tuple[Array, Array]:
    """Filtered channels at 100 Hz, (T, 6), and deflection, rate and hidden state of the spring, (T, 3).

    Road of random phases from 0.5 to 18 Hz.
    """
    random = np.random.default_rng(road)
    step = 1 / (100.0 * FINE)
    n = int((seconds + 0.6) * 100) * FINE
    omega = 2 * np.pi * np.linspace(0.5, 18, 160)
    size, phase = level * 6e-4 * 2 * np.pi / omega, random.uniform(0, 2 * np.pi, 160)
    angle = np.arange(2 * n + 1)[:, None] * (step / 2) * omega + phase
    ground, slope = np.sin(angle) @ size, np.cos(angle) @ (omega * size)
    felt, motion = _driven(law, values, ground.tolist(), slope.tolist(), step)
    channels = np.column_stack([ground[: 2 * n : 2], slope[: 2 * n : 2], felt[:, [0, 0, 1, 1]]])
    taps = firwin(40 * FINE + 1, 42.0, fs=100.0 * FINE)
    half, margin = len(taps) // 2, 30 * FINE
    filtered = oaconvolve(channels, taps[:, None], axes=0)[half:-half]
    return filtered[margin:-margin:FINE], motion[margin:-margin:FINE]


def _driven(
    law: OpenLaw, values: dict[str, Array], ground: list[float], slope: list[float], step: float
) -> tuple[Array, Array]:
    """Accelerations of car and bogie (n, 2), and motion of the spring (n, 3), by Runge-Kutta; the road at half steps.

    In plain numbers, which are quicker than arrays of five by a factor of five.
    """
    (k1, k2), (c1, c2) = values["stiffness"].tolist(), values["damping"].tolist()
    keep, force = 1 / law.time, law.force

    def rate(z1: float, z2: float, v1: float, v2: float, z: float, i: int) -> tuple[float, float, float]:
        d, v = z1 - z2, v1 - v2
        upper = k2 * d + c2 * v + force(d, v, z)
        lower = k1 * (z2 - ground[i]) + c1 * (v2 - slope[i])
        return -upper / 8000, (upper - lower) / 1300, v - z * keep

    z1 = z2 = v1 = v2 = z = 0.0
    felt, motion, half = [], [], step / 2
    for i in range(0, len(ground) - 1, 2):
        a1, a2, az = rate(z1, z2, v1, v2, z, i)
        felt.append((a1, a2))
        motion.append((z1 - z2, v1 - v2, z))
        p1, p2 = v1 + half * a1, v2 + half * a2
        b1, b2, bz = rate(z1 + half * v1, z2 + half * v2, p1, p2, z + half * az, i + 1)
        q1, q2 = v1 + half * b1, v2 + half * b2
        d1, d2, dz = rate(z1 + half * p1, z2 + half * p2, q1, q2, z + half * bz, i + 1)
        r1, r2 = v1 + step * d1, v2 + step * d2
        e1, e2, ez = rate(z1 + step * q1, z2 + step * q2, r1, r2, z + step * dz, i + 2)
        z1, z2 = z1 + step / 6 * (v1 + 2 * (p1 + q1) + r1), z2 + step / 6 * (v2 + 2 * (p2 + q2) + r2)
        v1, v2 = v1 + step / 6 * (a1 + 2 * (b1 + d1) + e1), v2 + step / 6 * (a2 + 2 * (b2 + d2) + e2)
        z = z + step / 6 * (az + 2 * (bz + dz) + ez)
    return np.array(felt), np.array(motion)


def errors_of(
    report: Report, finding: Finding, law: OpenLaw, values: dict[str, Array], motions: tuple[Array, Array]
) -> list[float]:
    """Errors of the whole force on the part that no fit saw, and on another ride at 1.5 times the amplitude."""
    found = {p.name: p.value for p in report.augmented}
    names: dict[str, Any] = {p.name: p.value for p in finding.parameters}
    names |= {"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "exp": np.exp, "abs": np.abs, "max": np.maximum}
    names |= {"sqrt": np.sqrt, "sign": np.sign}
    result = []
    for motion, share in zip(motions, (0.7, 0.3), strict=True):
        d, v, z = motion.T
        hidden = law.force(d, v, z)
        truth = values["stiffness"][1] * d + values["damping"][1] * v + hidden
        memory = _remembered(d, names["tau"]) if "tau" in names else 0.0
        with np.errstate(all="ignore"):
            told_force = eval(finding.formula, names, {"d": d, "v": v, "z": memory})
        model = found["secondary.stiffness"] * d + found["secondary.damping"] * v + told_force
        late = slice(int(share * len(d)), None)
        columns = np.column_stack([d, v, np.ones_like(d)])[late]
        own = hidden[late] - columns @ np.linalg.lstsq(columns, hidden[late], rcond=None)[0]
        error = (model - truth)[late]
        rms = math.sqrt(float(np.mean((error - error.mean()) ** 2)))
        result.append(rms / max(float(np.std(own)), 1e-300) if math.isfinite(rms) else math.inf)
    return result


def _remembered(d: Array, tau: float) -> Array:
    """z with z' = d' - z / tau, of samples at 100 Hz."""
    kept = math.exp(-0.01 / tau)
    gain = tau * (1 - kept) / 0.01
    return np.asarray(lfilter([gain, -gain], [1.0, -kept], d, zi=[-gain * d[0]])[0])
