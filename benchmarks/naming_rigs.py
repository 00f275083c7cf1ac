"""Components of `sprung bench naming`: what real rigs do, listed or not, as forces that are stepped along a motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

Stepped = Callable[[float, float, float], float]  # deflection m, rate m/s, step s -> force N; keeps its memory
TRAVEL = 0.02  # m


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


def _fluid(random: np.random.Generator) -> SimulatedRig:
    """A damper whose orifices make its force grow with a power of the rate."""
    force, exponent = random.uniform(500, 2000), random.uniform(0.25, 0.6)  # N at 1 m/s
    truth = {"force_at_0.1_m/s": force * 0.1**exponent, "exponent": exponent}
    return SimulatedRig(lambda x, v, h: force * math.copysign(abs(v) ** exponent, v), truth)


def _stopped(gap: float, hard: float, gap_compression: float, hard_compression: float, power: float) -> Stepped:
    """Stops on both sides; a stiffness is the force over the depth, a gap's length deep."""

    def step(x: float, v: float, h: float) -> float:
        over, under = max(x - gap, 0.0) / gap, max(-x - gap_compression, 0.0) / gap_compression
        force: float = hard * gap * over**power - hard_compression * gap_compression * under**power
        return force

    return step


def _one_stop(random: np.random.Generator) -> SimulatedRig:
    gap, hard = TRAVEL * random.uniform(0.4, 0.7), random.uniform(5e4, 3e5)
    return SimulatedRig(_stopped(gap, hard, 1.0, 0.0, 1.0), {"gap": gap, "stiffness": hard})


def _two_stops(random: np.random.Generator) -> SimulatedRig:
    gap, other = TRAVEL * random.uniform(0.3, 0.5), TRAVEL * random.uniform(0.55, 0.7)
    hard, hard_too = random.uniform(5e4, 2e5, 2)
    truth = {"gap": gap, "stiffness": hard, "gap_compression": other, "stiffness_compression": hard_too}
    return SimulatedRig(_stopped(gap, hard, other, hard_too, 1.0), truth)


def _progressive_stop(random: np.random.Generator) -> SimulatedRig:
    gap, other = TRAVEL * random.uniform(0.3, 0.6, 2)
    hard, power = random.uniform(4e4, 1.5e5), random.uniform(1.5, 2.5)
    truth = {"gap": gap, "exponent": power}  # its stiffness is told for the gap as a report counts it
    return SimulatedRig(_stopped(gap, hard, other, random.choice([0.0, 1.0]) * hard, power), truth)


def _valve_and_stop(random: np.random.Generator) -> SimulatedRig:
    valve, stop = _valve(random), _one_stop(random)
    return SimulatedRig(lambda x, v, h: valve.step(x, v, h) + stop.step(x, v, h), {**valve.truth, **stop.truth})


def _off_centre(random: np.random.Generator) -> SimulatedRig:
    force, centre = random.uniform(200, 600), TRAVEL * random.uniform(0.2, 0.5)
    return SimulatedRig(lambda x, v, h: force * ((x - centre) / TRAVEL) ** 3, {"k3": force / TRAVEL**3})


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


def _smooth(random: np.random.Generator) -> SimulatedRig:
    """A spring that hardens to one side and softens to the other, and a damper that the deflection makes stronger."""
    square, damped = random.uniform(200, 600) / TRAVEL**2, random.choice([0.0, 1.0]) * random.uniform(2e4, 8e4)
    return SimulatedRig(lambda x, v, h: square * x**2 + damped * x * abs(v))


def _softening(random: np.random.Generator) -> SimulatedRig:
    """A part of the spring that slips without hysteresis, to one side alone."""
    force, reach = random.uniform(200, 600), TRAVEL * random.uniform(0.3, 0.6)
    return SimulatedRig(lambda x, v, h: force * (1 - math.exp(-max(x, 0.0) / reach)) * (x > 0))


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
    "one-sided stop": RigKind(frozenset({"bump_stop"}), _one_stop),
    "stops at unequal travel": RigKind(frozenset({"bump_stop"}), _two_stops),
    "progressive stop": RigKind(frozenset({"progressive_stop"}), _progressive_stop),
    "valve beside a stop": RigKind(frozenset({"damper_blowoff", "bump_stop"}), _valve_and_stop),
    "spring off centre": RigKind(frozenset({"cubic_stiffness"}), _off_centre),
    "smooth spring": RigKind(frozenset(), _smooth),
    "softening to one side": RigKind(frozenset(), _softening),
    "fluid damper": RigKind(frozenset({"power_law_damping"}), _fluid),
}
