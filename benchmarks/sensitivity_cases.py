"""Recordings on which deciding numbers are varied: quarter cars, the bundled vehicle, component tests.

Laws strong, and weak enough that a report says so; faults of sensors and of inputs; wrong set-ups; healthy ones.
Some are there for what only they have: a high sampling rate, a force of no law, a part that the file lacks, a shaker
whose sensors are exchanged, a car of which accelerations alone are measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import yaml
from scipy.linalg import expm
from scipy.signal import butter, decimate, resample_poly, sosfiltfilt

from sprung.benchmarks.cars import EFFECTS, HUBS, recorded
from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.benchmarks.generator.ride import draw_ride
from sprung.benchmarks.generator.ride import record as ridden
from sprung.benchmarks.setups import FalsifiedRecording, falsified, in_order
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import BUNDLED, MANCHESTER, System, load_system, parse_system

SETUPS = ("late sensors", "scale of a node", "sign of a sensor")
RATE = 100.0  # Hz
RIG = """
name: damper on a test bench
sample_rate: 100
window: 64
inputs:
  rod: {kind: displacement, displacement: {csv: d, noise: 1e-6}}
elements:
  damper: {upper: rod, lower: ground, stiffness: 4.0e4, damping: 1.5e3}
sensors:
  cell: {kind: force, element: damper, csv: F, noise: 2.0}
"""
QUARTER_CAR = """
name: quarter-car
sample_rate: 100
window: 100
bodies:
  car: {mass: 8000}
  bogie: {mass: 1300}
inputs:
  wheel:
    kind: displacement
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
TOWER = """
name: tower
sample_rate: 50
window: 3000
bodies: {one: {mass: 1000}, two: {mass: 800}}
elements:
  lower: {upper: one, lower: ground, stiffness: 4.0e+5, damping: 400}
  upper: {upper: two, lower: one, stiffness: 3.0e+5, damping: 300}
sensors:
  a1: {kind: acceleration, body: one, noise: 0.001}
  a2: {kind: acceleration, body: two, noise: 0.001}
"""
TRACK = (BUNDLED / "accelerometers.yaml").read_text(encoding="utf-8") + "\nspeed: {csv: v, noise: 0.1}\n"
SHAKEN = """
name: shaken
sample_rate: 50
window: 200
bodies: {f1: {mass: {value: 4000.0, fixed: true}}, f2: {mass: {value: 4000.0, fixed: true}}}
inputs: {shaker: {kind: force, body: f2, csv: F, noise: 5}}
elements:
  s1: {upper: f1, lower: ground, stiffness: 2.0e+6, damping: 8.0e+3}
  s2: {upper: f2, lower: f1, stiffness: 2.0e+6, damping: 8.0e+3}
sensors:
  a1: {kind: acceleration, body: f1, csv: a1, noise: 0.003}
  b1: {kind: acceleration, body: f1, csv: b1, noise: 0.003}
  a2: {kind: acceleration, body: f2, csv: a2, noise: 0.003}
"""
STOREY = """
name: storey
sample_rate: 100
window: 1000
bodies: {floor: {mass: 1000}}
inputs: {base: {kind: support, acceleration: {csv: g, noise: 0.005}}}
elements: {storey: {upper: floor, lower: base, stiffness: 1.15e6, damping: 3.9e3}}
sensors: {a: {kind: acceleration, body: floor, csv: a, noise: 0.005}}
"""
FRAME = """
name: frame
sample_rate: 100
window: 400
bodies: {f1: {mass: 1000}, f2: {mass: 1000}, f3: {mass: 900}}
inputs: {table: {kind: displacement, displacement: {csv: d, noise: 1.0e-6}}}
elements:
  s1: {upper: f1, lower: table, stiffness: 1.3e+6, damping: 100}
  s2: {upper: f2, lower: f1, stiffness: 1.1e+6, damping: 100}
  s3: {upper: f3, lower: f2, stiffness: 1.0e+6, damping: 100}
sensors:
  a1: {kind: acceleration, body: f1, csv: a1, noise: 0.002}
  a2: {kind: acceleration, body: f2, csv: a2, noise: 0.002}
  a3: {kind: acceleration, body: f3, csv: a3, noise: 0.002}
"""
WHEEL, VELOCITY, CAR_A, CAR_B, BOGIE_A = range(5)  # columns of its recordings


@dataclass(frozen=True)
class QuarterCarCase:
    """What is wrong with a quarter car or with its recording."""

    name: str
    where: tuple[str, str] | None = None  # part of the system file
    law: dict[str, dict[str, Any]] | None = None
    wrong: Callable[[FloatArray], None] | None = None  # changes the recorded channels (T, C) in place
    rate: float = RATE  # Hz
    also: QuarterCarCase | None = None  # what is wrong besides


def _scaled(column: int, factor: float) -> Callable[[FloatArray], None]:
    def change(values: FloatArray) -> None:
        values[:, column] *= factor

    return change


def _exchanged(values: FloatArray) -> None:
    values[:, [CAR_A, BOGIE_A]] = values[:, [BOGIE_A, CAR_A]]


def _late(values: FloatArray) -> None:
    values[:, CAR_B] = np.roll(values[:, CAR_B], 5)


def _noisy(values: FloatArray) -> None:
    values[:, BOGIE_A] += 0.03 * np.random.default_rng(1).standard_normal(len(values))


def _law(name: str, part: str, law: str, **values: float) -> QuarterCarCase:
    return QuarterCarCase(name, ("elements", part), {law: values})


def _hung(part: str, mass: float, frequency: float) -> QuarterCarCase:
    values = {"mass": mass, "frequency": frequency, "damping_ratio": 0.04, "x": 0.0, "y": 0.0}
    return QuarterCarCase(f"mass below {part}", ("bodies", part), {"suspended_mass": values})


CASES = (
    _law("friction", "secondary", "coulomb_friction", force=300, smoothing=2e-3),
    _law("weak friction", "secondary", "coulomb_friction", force=12, smoothing=2e-3),
    _law("cubic spring", "secondary", "cubic_stiffness", k3=4e9),
    QuarterCarCase("gain", ("sensors", "bogie_a"), {"sensor_gain": {"gain": 0.95}}),
    QuarterCarCase("scale", wrong=_scaled(CAR_A, 2.0)),
    QuarterCarCase("healthy"),
    _law("blow-off", "secondary", "damper_blowoff", knee=0.02, ratio=0.3),
    # beyond the quick ones
    _law("weak cubic spring", "secondary", "cubic_stiffness", k3=1.5e9),
    _law("bump stop", "secondary", "bump_stop", gap=4e-3, stiffness=4e5),
    _law("weak bump stop", "secondary", "bump_stop", gap=6e-3, stiffness=2e5),
    _law("hysteresis", "secondary", "bouc_wen", alpha=2e5, beta=1000.0, n=1.0),
    _law("asymmetry", "secondary", "damper_asymmetry", a=0.3),
    _law("weak asymmetry", "secondary", "damper_asymmetry", a=0.04),
    _law("series spring", "secondary", "series_stiffness", ks=1.2e6),
    _law("primary friction", "primary", "coulomb_friction", force=60, smoothing=2e-3),
    QuarterCarCase("lag", ("sensors", "bogie_a"), {"sensor_lag": {"time": 2e-3}}),
    QuarterCarCase("small gain", ("sensors", "car_a"), {"sensor_gain": {"gain": 0.985}}),
    QuarterCarCase("noise", wrong=_noisy),
    QuarterCarCase("input", wrong=_scaled(VELOCITY, 1.05)),
    QuarterCarCase("sign", wrong=_scaled(BOGIE_A, -1.0)),
    QuarterCarCase("exchanged", wrong=_exchanged),
    QuarterCarCase("late", wrong=_late),
    QuarterCarCase("healthy"),
    _law("softening spring", "secondary", "time_varying_stiffness", p=-0.1, tau=5.0),
)


PARTICULAR = (
    QuarterCarCase("fast", ("elements", "secondary"), CASES[0].law, rate=1000.0),
    QuarterCarCase(
        "no law", ("elements", "secondary"), {"formula": {"formula": "a * v * abs(d) / (0.01 + abs(d))", "a": 2e4}}
    ),
    _hung("car", 900.0, 6.0),
    replace(_hung("car", 900.0, 6.0), name="two masses", also=_hung("bogie", 150.0, 14.0)),
    QuarterCarCase("noise", wrong=_noisy),
)


Made = tuple[System, FalsifiedRecording]


def recordings(budget: str, count: int, seconds: float, seed: int) -> Iterator[tuple[str, Callable[[], Made]]]:
    """Of a vehicle, wrong set-ups among them, then component tests and structures, each made when it is asked for.

    budget: quick, cases or full.
    """
    rigs = max(1, count // 8)
    made = _vehicles if budget == "full" else quarter_cars
    for number, (what, make) in enumerate(made(count - rigs, seconds, seed)):
        yield f"{number}-{what}", make
    for number in range(rigs):
        yield f"rig-{number}", partial(_made, RIG, rig, seed + 2 + number, seconds)
    yield "tower", partial(_made, TOWER, tower, seed + 1)
    yield "track", partial(_made, TRACK, track, seed + 5)
    for number, case in enumerate(PARTICULAR):
        yield case.name, partial(quarter_car, case, seconds, seed + 100 + number)
    for name, imperfect in IMPERFECT.items():
        yield f"rig {name}", partial(_made, RIG, partial(rig, imperfect=imperfect), seed + 2, seconds)
    yield "shaken, exchanged", partial(_made, SHAKEN, shaken, seed + 3)
    yield "accelerations", partial(_on_hubs, seed + 4)
    yield "frame", partial(_made, FRAME, frame, seed + 6)
    yield "joint", partial(_made, STOREY, storey, seed + 7)


def _made(text: str, make: Callable[..., FalsifiedRecording], seed: int, *more: float) -> Made:
    return parse_system(text), make(np.random.default_rng(seed), *more)


def _on_hubs(seed: int) -> Made:
    """A car of which accelerations alone are measured, with a damper that is harder in extension."""
    effect = next(one for one in EFFECTS if (one.file, one.law) == (HUBS, "damper_asymmetry"))
    system, values = recorded(effect, np.random.default_rng(seed))
    return system, FalsifiedRecording("", frozenset(), values, sample_rate=system.sample_rate)


def _known(system: System, record: FalsifiedRecording) -> Made:
    return system, record


def _vehicles(count: int, seconds: float, seed: int) -> Iterator[tuple[str, Callable[[], Made]]]:
    """The bundled vehicle, laws strong and weak, by the independent generator."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    kinds = ["clean", "coulomb_friction", "bump_stop", "sensor_gain", "sensor_noise", "bouc_wen", "damper_asymmetry"]
    random = np.random.default_rng(seed)
    strong = draw_cases(vehicle, (count + 1) // 2, seed, kinds, 0.3)
    cases = [*strong, *draw_cases(vehicle, count - len(strong), seed + 1, kinds, 1.5)]
    for number, made in enumerate(make_recordings(vehicle, cases, seconds)):
        values = in_order(system, made.values)
        record, what = FalsifiedRecording("", frozenset(), values), made.case.kind
        if what == "clean" and number < len(strong):  # the others stay healthy
            record = falsified(system, values, SETUPS[number % len(SETUPS)], random)
            what = record.kind
        yield what, partial(_known, system, record)


def quarter_cars(count: int, seconds: float, seed: int) -> Iterator[tuple[str, Callable[[], Made]]]:
    """A quarter car on a road of random phases, whose parameters differ from the file's by 8 %."""
    for number in range(count):
        case = CASES[number % len(CASES)]
        yield case.name, partial(quarter_car, case, seconds, seed + number)


def quarter_car(case: QuarterCarCase, seconds: float, seed: int) -> Made:
    """Its system file, which knows nothing of what is wrong, and a recording."""
    random = np.random.default_rng(seed)
    file = yaml.safe_load(QUARTER_CAR) | {"sample_rate": case.rate}
    system = parse_system(yaml.safe_dump(file, sort_keys=False))
    for one in (case, case.also):
        if one is not None and one.where is not None:
            file[one.where[0]][one.where[1]]["laws"] = [one.law]
    time = np.arange(round(seconds * case.rate)) / case.rate
    f, phase = np.linspace(0.5, 18, 160), random.uniform(0, 2 * np.pi, 160)
    angle = 2 * np.pi * f * time[:, None] + phase
    road = np.column_stack([np.sin(angle) @ (6e-4 / f), np.cos(angle).sum(axis=1) * 6e-4 * 2 * np.pi])
    values = {p.name: p.nominal * float(np.exp(0.08 * random.standard_normal())) for p in system.parameters}
    sensors = simulate_ride(parse_system(yaml.safe_dump(file, sort_keys=False)), road, values, noise=random).sensors
    shown = road + np.array([1e-5, 5e-4]) * random.standard_normal(road.shape)
    channels = np.column_stack([shown, sensors])
    if case.wrong is not None:
        case.wrong(channels)
    return system, FalsifiedRecording("", frozenset(), channels, sample_rate=case.rate)


TWO_SINES = ((0.012, 0.7, 0.3), (0.004, 1.9, 1.0))  # amplitude m, frequency Hz, phase


@dataclass(frozen=True)
class Imperfect:
    """How a damper on a test bench differs from one with dry friction under two sines."""

    sines: tuple[tuple[float, float, float], ...] = TWO_SINES
    fall: float = 0.0  # of the friction with the rate
    late: float = 0.0  # s, of the force's channel
    rubs: bool = True
    joint: float = 0.0  # N, of sliders that slip one after the other
    quadratic: float = 0.0  # N s^2/m^2
    wrong: tuple[tuple[float, FloatArray], ...] = ()  # when, of the test, and errors of values in a row, N


IMPERFECT = {
    "falling friction": Imperfect(fall=0.6),
    "one loop": Imperfect(((0.012, 1.0, 0.3),)),
    "late": Imperfect(late=0.03, rubs=False),
    "joint": Imperfect(rubs=False, joint=300.0),
    "quadratic beside friction": Imperfect(quadratic=3e3),
    "wrong values": Imperfect(wrong=((0.2, np.array([1500.0])), (0.5, np.array([1200.0, 900.0])))),
}


class Sliders:
    """A lap joint (Iwan): sliders that slip one after the other, more of them the further."""

    def __init__(self, stiffness: float, force: float, count: int = 30) -> None:
        """stiffness: of all, N/m; force: of all as they slip, N."""
        share = np.linspace(0, 1, count + 1)
        self.stiffness, middle = stiffness * np.diff(np.sqrt(share)), share[1:] - 0.5 / count
        self.reach = force / float(self.stiffness @ middle) * middle
        self.held, self.last = np.zeros(count), 0.0

    def force(self, d: float) -> float:
        """Force at the next deflection, N."""
        self.held, self.last = np.clip(self.held + (d - self.last), -self.reach, self.reach), d
        return float(self.stiffness @ self.held)


def storey(random: np.random.Generator, seconds: float = 40.0, count: int = 30) -> FalsifiedRecording:
    """A floor on a spring, a damper and a lap joint, on ground that shakes; with one slider, a spring that slips."""
    finer = 10
    steps, step = round(seconds * RATE) * finer, 1 / (RATE * finer)
    band = butter(2, [0.4, 8.0], "bandpass", fs=RATE * finer, output="sos")
    ground = sosfiltfilt(band, random.standard_normal(steps + 2000 * finer))[1000 * finer : -1000 * finer]
    ground *= 1.5 / np.std(ground)
    joint, floor, d, v = Sliders(6e5, 1500.0, count), np.empty(steps), 0.0, 0.0
    for i, base in enumerate(ground.tolist()):
        floor[i] = -(1e6 * d + 3e3 * v + joint.force(d)) / 1e3
        v += step * (floor[i] - base)
        d += step * v
    shown = resample_poly(np.column_stack([ground, floor]), 1, finer)
    return FalsifiedRecording("", frozenset(), shown + 0.005 * random.standard_normal(shown.shape))


def rig(random: np.random.Generator, seconds: float, imperfect: Imperfect = Imperfect()) -> FalsifiedRecording:
    """A damper with dry friction under sines."""
    t = np.arange(int(seconds * RATE)) / RATE - imperfect.late
    sines = imperfect.sines
    still = np.zeros_like(t)
    d = sum((size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in sines), start=still)
    v = sum((size * 2 * np.pi * f * np.cos(2 * np.pi * f * t + phase) for size, f, phase in sines), start=still)
    falls = imperfect.rubs * (1 + imperfect.fall * (np.exp(-((v / 0.02) ** 2)) - 1))
    force = 3.6e4 * d + 1.3e3 * v + random.uniform(40.0, 160.0) * falls * np.tanh(v / 1e-3)
    force += imperfect.quadratic * v * np.abs(v)
    if imperfect.joint:
        joint = Sliders(6e4, imperfect.joint)
        force += [joint.force(float(at)) for at in d]
    noise = random.standard_normal((2, len(t)))
    for share, errors in imperfect.wrong:
        at = int(share * len(t))
        force[at : at + len(errors)] += errors
    if imperfect.late:
        t = t + imperfect.late
        d = np.sum([size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in sines], axis=0)
    return FalsifiedRecording("", frozenset(), np.column_stack([d + 1e-6 * noise[0], force + 2.0 * noise[1]]))


def shaken(random: np.random.Generator, samples: int = 4000) -> FalsifiedRecording:
    """Two floors under a measured force, the sensors of one floor each exchanged, springs 15 % off nominal."""
    fine, mass, H = 8, 4000.0, np.array([[1.0, 0.0], [-1.0, 1.0]])
    spectrum = np.fft.rfft(random.standard_normal(samples))
    frequency = np.fft.rfftfreq(samples, 1 / 50)
    spectrum *= (frequency > 0.3) * np.exp(-((frequency / 12) ** 8))
    force = fine * np.fft.irfft(spectrum, samples * fine)
    force *= 800 / np.std(force)
    K = (H.T * np.array([2.3e6, 1.7e6])) @ H
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K / mass, -0.004 * K / mass]])
    ahead = expm(A / (50 * fine))
    push = np.linalg.solve(A, (ahead - np.eye(4))[:, 3]) / mass
    x, states = np.zeros(4), np.empty((len(force), 4))
    for i, given in enumerate(0.5 * (force + np.append(force[1:], force[-1]))):
        states[i], x = x, ahead @ x + push * given
    floors = (states @ A[2:].T + np.outer(force, [0.0, 1 / mass]))[::fine]
    shown = np.column_stack([force[::fine], floors[:, 0], floors[:, 1], floors[:, 0]])  # b1 and a2 exchanged
    return FalsifiedRecording(
        "", frozenset(), shown + random.normal(0, 1, shown.shape) * [5, 3e-3, 3e-3, 3e-3], sample_rate=50.0
    )


def frame(random: np.random.Generator, seconds: float = 60.0) -> FalsifiedRecording:
    """A frame on a shaken table whose modes are damped one by one, the second most."""
    file = yaml.safe_load(FRAME)
    file["bodies"]["f1"]["laws"] = [{"modal_damping": {"mode_1": 0.012, "mode_2": 0.03, "mode_3": 0.012}}]
    time = np.arange(round(seconds * RATE)) / RATE
    f, phase = np.linspace(0.5, 18, 400), random.uniform(0, 2 * np.pi, 400)
    table = (np.sin(2 * np.pi * f * time[:, None] + phase) @ (2e-4 / f))[:, None]
    system = parse_system(yaml.safe_dump(file, sort_keys=False))
    values = {p.name: p.nominal * float(np.exp(0.08 * random.standard_normal())) for p in system.parameters}
    sensors = simulate_ride(system, table, values, noise=random).sensors
    shown = table + 1e-6 * random.standard_normal(table.shape)
    return FalsifiedRecording("", frozenset(), np.column_stack([shown, sensors]))


def track(random: np.random.Generator, seconds: float = 120.0) -> FalsifiedRecording:
    """A healthy vehicle on a track that nobody measures, with its speed."""
    ride = draw_ride(random, speed=(42.0, 42.0))
    sensors = ridden(random, ride, seconds)
    speed = ride.speed + 0.1 * random.standard_normal(len(sensors))
    return FalsifiedRecording("", frozenset(), np.column_stack([speed, sensors]))


def tower(random: np.random.Generator, seconds: float = 360.0) -> FalsifiedRecording:
    """A tower under forces that nobody measured, one of whose springs is a tenth softer in the second half."""
    mass, fine = np.array([1000.0, 800.0]), 8
    H, damping = np.array([[1.0, 0.0], [-1.0, 1.0]]), np.array([500.0, 260.0])
    steps, step = round(seconds * 50) * fine, 1 / (50 * fine)
    push = random.normal(0, 50 * np.sqrt(fine), (steps, 2)) / mass
    x, acceleration = np.zeros(4), np.empty((steps, 2))
    for half, stiffness in enumerate((np.array([4.6e5, 2.7e5]), np.array([4.6e5, 2.43e5]))):
        A = np.block(
            [
                [np.zeros((2, 2)), np.eye(2)],
                [-(H.T * stiffness) @ H / mass[:, None], -(H.T * damping) @ H / mass[:, None]],
            ]
        )
        ahead = expm(A * step)
        given = np.linalg.solve(A, ahead - np.eye(4))[:, 2:]
        for i in range(half * steps // 2, (half + 1) * steps // 2):
            acceleration[i] = A[2:] @ x + push[i]
            x = ahead @ x + given @ push[i]
    shown = decimate(acceleration, fine, ftype="fir", axis=0, n=20 * fine)
    return FalsifiedRecording("", frozenset(), shown + random.normal(0, 0.001, shown.shape), sample_rate=50.0)
