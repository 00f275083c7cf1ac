"""A train's working day as it runs: when it stops, how fast it is, who is on board, how warm it is, what wears.

Everything here is a function of time that `running.py` turns into signals, and so is the truth about them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

STEP = 0.1  # s, grid of the timetable
MONTH = 365.25 / 12 * 86400.0
REFERENCE = 20.0  # degC at which elements have their nominal values
JERK_TIME = 2.0  # s in which acceleration builds up


@dataclass(frozen=True)
class Fault:
    """A change of an element's value or of a channel's gain, sudden or over a while."""

    target: str  # "secondary_1l.damping", "bogie1_1l.gain"
    at: float  # s
    ratio: float  # what remains of the value, or the gain
    over: float = 0.0  # s; 0: at once

    def factor(self, time: Array) -> Array:
        """On the value at times, s."""
        part = np.clip((time - self.at) / self.over, 0.0, 1.0) if self.over > 0 else (time >= self.at).astype(float)
        return np.asarray(self.ratio**part)


@dataclass(frozen=True)
class Service:
    """What a working day has; every range is drawn from evenly."""

    stop_every: tuple[float, float] = (180.0, 480.0)  # s from departure to departure
    dwell: tuple[float, float] = (20.0, 60.0)  # s at a platform
    cruise: tuple[float, float] = (20.0, 50.0)  # m/s between stops
    crawling: float = 0.3  # share of stops that are approached at walking pace for a while
    load: tuple[float, float] = (-0.3, 0.3)  # of the empty car's mass, drawn anew at every stop
    off_centre: float = 0.5  # m, standard deviation of the load's centre along the car
    load_spread: tuple[float, float] = (0.6, 1.1)  # of a load's inertias; 1: spread like the car
    gain_drift: float = 0.02  # per month, standard deviation of every channel's
    clock: float = 5e-3  # s, largest offset of a node's clock
    temperature: tuple[float, float] = (-20.0, 40.0)  # degC of the air, drawn for the day
    daily_swing: float = 8.0  # K above and below
    warm_up: float = 10.0  # K of the dampers' oil above the air when it has run
    damper_slope: float = -0.002  # per K
    rubber_slope: float = -0.0015  # per K below the reference: rubber stiffens in the cold
    wear: float = 0.01  # per month, standard deviation of each element's slow loss
    curves: float = 0.3  # share of running time in curves
    joints: float = 0.15  # share of the line with jointed rails
    switches: bool = True  # two at either end of every station
    spread: float = 0.1  # of the vehicle's own values about nominal
    level: tuple[float, float] = (0.9, 1.6)  # of the track's roughness, against the low ERRI level in amplitude
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True)
class Timetable:
    """One drawn day, on a grid of `STEP` seconds, shape (N,) each."""

    service: Service
    time: Array
    speed: Array  # m/s
    acceleration: Array  # m/s^2, along the line
    lateral: Array  # m/s^2, unbalanced, in curves
    yaw_rate: Array  # rad/s
    load: Array  # of the empty mass: what is carried
    centre: Array  # m, of the load along the car
    spread: Array  # of the load's inertias, see `Service.load_spread`: roll and pitch, shape (N, 2)
    air: Array  # degC
    oil: Array  # degC
    boarding: Array  # 1 while doors are open
    stations: tuple[float, ...]  # m along the line
    own: Array  # log-ratios of the vehicle's elements at the reference temperature, shape (2 E,)
    worn: Array  # per second, shape (2 E,)
    gain_rate: Array  # per second, shape (C,)
    offset: Array  # s by which each channel's clock is late, shape (C,)
    seed: int
    clock_nodes: dict[str, float] = field(default_factory=dict)

    def at(self, series: Array, time: Array | float) -> Array:
        """A series at other times."""
        return np.asarray(np.interp(time, self.time, series))

    def log_ratio(self, vehicle: Vehicle, time: float) -> Array:
        """True log-ratios of stiffnesses and dampings at a time, shape (2 E,)."""
        E = len(vehicle.elements)
        cold = self.service.rubber_slope * np.minimum(float(self.at(self.air, time)) - REFERENCE, 0.0)
        warm = self.service.damper_slope * (float(self.at(self.oil, time)) - REFERENCE)
        rubber = np.array([cold if wheel >= 0 else 0.0 for wheel in vehicle.support])
        out = self.own - self.worn * time
        out = out + np.concatenate([rubber, np.full(E, np.log1p(warm))])
        for fault in self.service.faults:
            element, _, quantity = fault.target.rpartition(".")
            if quantity in ("stiffness", "damping"):
                row = vehicle.elements.index(element) + (E if quantity == "damping" else 0)
                out[row] += np.log(float(fault.factor(np.array(time))))
        return np.asarray(out)

    def gains(self, channels: list[str], time: Array) -> Array:
        """Gain of every channel, shape (T, C)."""
        out = 1.0 + self.gain_rate * time[:, None]
        for fault in self.service.faults:
            channel, _, kind = fault.target.rpartition(".")
            if kind == "gain":
                out[:, channels.index(channel)] *= fault.factor(time)
        return np.asarray(out)


def nodes(vehicle: Vehicle) -> list[str]:
    """The node that sends each channel: topics of one body come from one clock."""
    return [place.get("mcap", name).strip("/").split("/")[0] for name, place in
            zip(vehicle.channels, vehicle.places, strict=True)]  # fmt: skip


def draw_timetable(vehicle: Vehicle, service: Service, seconds: float, seed: int, start: float = 0.0) -> Timetable:
    """A day of `seconds`; `start`: s since midnight, for the temperature."""
    rng = np.random.default_rng([seed, 1])
    time = np.asarray(np.arange(round(seconds / STEP) + 1) * STEP, dtype=np.float64)
    speed, boarding, load, centre, stops = _runs(rng, service, len(time))
    smooth = max(round(JERK_TIME / STEP), 1)
    speed = np.convolve(np.pad(speed, smooth // 2, mode="edge"), np.ones(smooth) / smooth, mode="same")
    speed = speed[smooth // 2 : smooth // 2 + len(time)]
    speed[speed < 1e-3] = 0.0
    yaw, lateral = _curves(rng, service, speed)
    mean = rng.uniform(*service.temperature)
    air = mean + service.daily_swing * np.sin(2 * np.pi * (start + time - 9 * 3600) / 86400)
    oil = air + service.warm_up * (1 - np.exp(-time / 1200.0))
    E, C = len(vehicle.elements), len(vehicle.channels)
    clocks = {node: float(rng.uniform(-service.clock, service.clock)) for node in dict.fromkeys(nodes(vehicle))}
    place = np.cumsum(speed) * STEP
    spread = _spreads(np.random.default_rng([seed, 5]), service, load)
    return Timetable(
        service, time, speed, np.gradient(speed, STEP), lateral, yaw, load, centre, spread, air, oil, boarding,
        tuple(float(place[i]) for i in stops),
        np.log(rng.uniform(1 - service.spread, 1 + service.spread, 2 * E)),
        np.abs(rng.normal(0, max(service.wear, 1e-300), 2 * E)) / MONTH,
        rng.normal(0, max(service.gain_drift, 1e-300), C) / MONTH,
        np.array([clocks[node] for node in nodes(vehicle)]),
        seed, clocks,
    )  # fmt: skip


def _runs(rng: np.random.Generator, service: Service, count: int) -> tuple[Array, Array, Array, Array, list[int]]:
    """Speed, open doors, load and its centre on the grid, and where the train stands."""
    speed, doors, load, centre = (np.zeros(0) for _ in range(4))
    stops: list[int] = []
    carried, where = rng.uniform(*service.load), rng.normal(0, service.off_centre)
    while len(speed) < count:
        stand, whole = rng.uniform(*service.dwell), rng.uniform(*service.stop_every)
        before, carried = carried, rng.uniform(*service.load)
        shifted, where = where, rng.normal(0, service.off_centre)
        stops.append(len(speed))
        standing = round(stand / STEP)
        shape = _run(rng, service, max(whole - stand, 60.0))
        speed = np.concatenate([speed, np.zeros(standing), shape])
        exchange = np.clip(np.linspace(-0.3, 1.3, standing), 0, 1)
        doors = np.concatenate([doors, (exchange > 0) & (exchange < 1), np.zeros(len(shape))])
        load = np.concatenate([load, before + (carried - before) * exchange, np.full(len(shape), carried)])
        centre = np.concatenate([centre, shifted + (where - shifted) * exchange, np.full(len(shape), where)])
    return speed[:count], doors[:count], load[:count], centre[:count], [s for s in stops if s < count]


def _spreads(rng: np.random.Generator, service: Service, load: Array) -> Array:
    """How each load is spread, (N, 2): another whenever it has changed."""
    stays = np.concatenate([[False], np.diff(load) == 0])
    number = np.cumsum(~stays & np.concatenate([[True], stays[:-1]]))
    return np.asarray(rng.uniform(*service.load_spread, (int(number[-1]) + 1, 2))[number])


def _run(rng: np.random.Generator, service: Service, seconds: float) -> Array:
    """Speed from one stop to the next: away, on, braking, sometimes at walking pace to the platform."""
    up, down = rng.uniform(0.5, 0.8), rng.uniform(0.5, 0.8)
    top = min(rng.uniform(*service.cruise), 0.8 * seconds / (1 / up + 1 / down))
    pace = 2.0 if rng.random() < service.crawling else 0.0
    t = np.arange(round(seconds / STEP)) * STEP
    ending = seconds - (15.0 if pace else 0.0)
    speed = np.minimum(np.minimum(up * t, top), np.maximum(down * (ending - t), pace))
    slower = rng.uniform(0.6, 1.0)  # a restriction in the middle, braked for and left as stations are
    allowed = slower * top + down * np.maximum(0.4 * seconds - t, 0) + up * np.maximum(t - 0.6 * seconds, 0)
    return np.asarray(np.minimum(speed, allowed))


def _curves(rng: np.random.Generator, service: Service, speed: Array) -> tuple[Array, Array]:
    """Yaw rate and unbalanced lateral acceleration of alternating straights and curves."""
    curvature, at = np.zeros(len(speed)), 0
    while at < len(speed):
        length = round(rng.uniform(15, 40) / STEP)
        straight = round(length * (1 / max(service.curves, 1e-3) - 1)) if service.curves > 0 else len(speed)
        at += straight
        radius = rng.uniform(600, 3000) * rng.choice([-1, 1])
        curvature[at : at + length] = 1 / radius
        at += length
    ease = round(4.0 / STEP)  # s of transition curve
    curvature = np.convolve(curvature, np.ones(ease) / ease, mode="same")
    yaw = curvature * speed
    return yaw, 0.4 * np.clip(speed * yaw, -2.5, 2.5)  # most of it is balanced by cant
