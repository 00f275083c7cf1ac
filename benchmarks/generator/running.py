"""A working day of a linear vehicle, simulated exactly: signals of all channels, stretch by stretch.

Rails are profiles over distance, so that a wheel that stands still is still and one that crawls sees the same rail
slowly.  Over a stretch in which load, temperature and wear are constant, the vehicle is linear: its modes are
first-order recursions, run as filters, with inputs taken as linear between samples of 1 kHz.  The state goes on from
stretch to stretch.  All channels pass the same low-pass before they are sampled at 100 Hz.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from sprung.benchmarks.generator.timetable import STEP, Timetable
from sprung.benchmarks.generator.track import LONGEST, LOW_TRACK, SHORTEST, errib176
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

RATE = 1000.0  # Hz, of the simulation
SAMPLED = 100.0  # Hz
STRETCH = 5.0  # s in which the vehicle is taken as constant
GRID = 0.1  # m between points of a rail
LOW_PASS = signal.firwin(161, 43.5, window=("kaiser", 6.0), fs=RATE)
REACH = 120  # samples of 1 kHz on either side of an output: filter and clock offsets
GRAVITY_HEIGHT = 0.9  # m, of the car's centre above where it is held, for braking and curves
PEOPLE = 150.0  # N, of steps and doors while people board


class Rails:
    """Left and right profile over distance, both the same in part, with joints and switches."""

    def __init__(self, timetable: Timetable, length: float, level: float) -> None:
        service = timetable.service
        rng = np.random.default_rng([timetable.seed, 2])
        count = int(2 ** np.ceil(np.log2(length / GRID)))
        common, left, right = (_profile(rng, count, level) for _ in range(3))
        place = np.arange(count) * GRID
        knots = np.arange(0, place[-1] + 2e3, 1e3)
        rough = np.interp(place, knots, rng.uniform(*service.level, len(knots)))
        dips = _dips(rng, timetable, count)
        both = np.sqrt(0.5)
        self.coefficients = {
            side: ndimage.spline_filter1d(rough * both * (common + own) + dips, order=3)
            for side, own in ((1.0, left), (-1.0, right))
        }

    def at(self, side: float, place: Array) -> Array:
        """Height at places along the line, m."""
        return np.asarray(
            ndimage.map_coordinates(self.coefficients[side], [place / GRID], order=3, mode="mirror", prefilter=False)
        )


def _profile(rng: np.random.Generator, count: int, level: float) -> Array:
    """One random profile with the ERRI B176 spectrum on the grid."""
    wave = np.asarray(2 * np.pi * np.fft.rfftfreq(count, GRID), dtype=np.float64)
    edge = 1 / (1 + (LONGEST / np.maximum(wave, 1e-9)) ** 16)
    density = errib176(wave, level) * edge * (wave <= SHORTEST) * 2 * np.pi  # m^2 per 1/m
    random = rng.normal(size=wave.size) + 1j * rng.normal(size=wave.size)
    return np.asarray(np.fft.irfft(np.sqrt(density * count / (4 * GRID)) * random, count))


def _dips(rng: np.random.Generator, timetable: Timetable, count: int) -> Array:
    """Joints every 18 to 30 m where the line has them, and switches before and after stations."""
    service = timetable.service
    depth = np.zeros(count)
    length = count * GRID
    at = 0.0
    while at < length and service.joints > 0:
        section = rng.uniform(800, 2000)
        at += section * (1 / service.joints - 1)
        places = np.arange(at, min(at + section, length - 1), rng.uniform(18, 30))
        depth[(places / GRID).astype(int)] += rng.uniform(1e-3, 4e-3, len(places))
        at += section
    for station in timetable.stations if service.switches else ():
        for away in (-260.0, -225.0, 225.0, 260.0):
            if 0 < station + away < length - 1:
                depth[int((station + away) / GRID)] += rng.uniform(2e-3, 6e-3)
    reach = np.arange(-40, 41) * GRID
    shape = np.exp(-np.abs(reach) / 0.45)
    round_ = np.exp(-0.5 * (reach / 0.35) ** 2)  # of a wheel's contact: nothing above 45 Hz at 50 m/s
    shape = np.convolve(shape, round_ / round_.sum(), mode="same")
    return np.asarray(-ndimage.convolve1d(depth, shape))


@dataclass
class _Modes:
    """A constant vehicle as decoupled first-order recursions."""

    roots: NDArray[np.complex128]  # (N,)
    vectors: NDArray[np.complex128]  # (N, N)
    drive: NDArray[np.complex128]  # modal force per input, (N, U)
    shown: NDArray[np.complex128]  # sensors per mode, (S, N)
    direct: Array  # sensors per input, (S, U)

    def rest(self, inputs: Array) -> Array:
        """The state in which it stands still under constant inputs (U,)."""
        return np.asarray((self.vectors @ (-(self.drive @ inputs) / self.roots)).real)

    def run(self, state: Array, inputs: Array) -> tuple[Array, Array]:
        """Sensors (T, S) at the inputs' times (T, U), and the state after the last."""
        z = self.roots / RATE
        step = np.exp(z)
        first = (step - 1) / z
        second = (step - 1 - z) / z**2
        modal = inputs @ self.drive.T
        at = np.linalg.solve(self.vectors, state.astype(complex))
        motion = np.empty_like(modal)
        motion[0] = at
        for m in range(len(z)):
            force = ((first[m] - second[m]) * modal[:-1, m] + second[m] * modal[1:, m]) / RATE
            motion[1:, m] = signal.lfilter([1.0], [1.0, -step[m]], force, zi=[step[m] * at[m]])[0]
        sensors = (motion @ self.shown.T).real + inputs @ self.direct.T
        return sensors, (self.vectors @ motion[-1]).real


def modes(vehicle: Vehicle, log_ratio: Array, load: float, centre: float, spread: Array) -> _Modes:
    """The vehicle with these values, a load (of the car's mass) at `centre` m along it.

    spread: roll and pitch inertia of the load against one that is spread like the car's own mass, (2,).

    Inputs: displacements and velocities of the wheels, roll and pitch moment and vertical force on the car.
    """
    E, n = len(vehicle.elements), len(vehicle.inertia)
    k, c = vehicle.stiffness * np.exp(log_ratio[:E]), vehicle.damping * np.exp(log_ratio[E:])
    mass = np.diag(vehicle.inertia.copy())
    car = vehicle.on_body(vehicle.bodies[0])
    mass[car, car] *= 1 + load * np.array([1.0, *spread])
    empty = vehicle.inertia[car.start]
    mass[car.start, car.start + 2] = mass[car.start + 2, car.start] = empty * load * centre
    mass[car.start + 2, car.start + 2] += empty * abs(load) * centre**2
    stands = np.zeros((E, len(vehicle.inputs)))
    for row, wheel in enumerate(vehicle.support):
        if wheel >= 0:
            stands[row, wheel] = 1.0
    H, inverse = vehicle.geometry, np.linalg.inv(mass)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:, :n], A[n:, n:] = -inverse @ (H.T * k) @ H, -inverse @ (H.T * c) @ H
    outside = np.zeros((n, 3))
    outside[[car.start + 1, car.start + 2, car.start], [0, 1, 2]] = 1.0
    forced = inverse @ np.hstack([(H.T * k) @ stands, (H.T * c) @ stands, outside])
    B = np.vstack([np.zeros_like(forced), forced])
    roots, vectors = np.linalg.eig(A)
    return _Modes(
        roots, vectors, np.linalg.solve(vectors, B.astype(complex)), vehicle.pickup @ A[n:] @ vectors,
        vehicle.pickup @ B[n:],
    )  # fmt: skip


def run_day(vehicle: Vehicle, timetable: Timetable, level: float = LOW_TRACK) -> Iterator[Array]:
    """What all channels measure at 100 Hz: arrays (T, C), one after the other, C as `Vehicle.channels` has them."""
    duration = float(timetable.time[-1])
    fine = np.arange(round(duration * RATE) + 1) / RATE
    place = _place(timetable, fine)
    rails = Rails(timetable, float(place[-1]) + 60.0, level)
    names, noise = vehicle.channels, np.concatenate([vehicle.input_noise.ravel(), vehicle.sensor_noise])
    rng = np.random.default_rng([timetable.seed, 3])
    state = np.zeros(2 * len(vehicle.inertia))
    held, held_from, taken = np.zeros((0, len(names))), 0, 0
    total = int(duration * SAMPLED)
    samples = round(STRETCH * RATE)
    front = vehicle.input_position.max()
    for start in range(0, len(fine) - 1, samples):
        stop = min(start + samples, len(fine) - 1)
        lead = slice(max(start - 8, 0), min(stop + 9, len(fine)))
        inputs = np.hstack([
            _wheels(vehicle, rails, place[lead], front)[start - lead.start : stop + 1 - lead.start],
            _outside(vehicle, timetable, fine[start : stop + 1], rng),
        ])  # fmt: skip
        middle = 0.5 * (fine[start] + fine[stop])
        vehicle_now = modes(
            vehicle, timetable.log_ratio(vehicle, middle),
            float(timetable.at(timetable.load, middle)), float(timetable.at(timetable.centre, middle)),
            timetable.spread[int(middle / STEP)],
        )  # fmt: skip
        state = vehicle_now.rest(inputs[0]) if start == 0 else state
        sensors, state = vehicle_now.run(state, inputs)
        W = len(vehicle.inputs)
        held = np.vstack([held, np.hstack([inputs[:-1, : 2 * W], sensors[:-1]])])
        known = held_from + len(held)
        last = total if stop == len(fine) - 1 else min(total, int((known - REACH) / (RATE / SAMPLED)))
        if last <= taken:
            continue
        time = np.arange(taken, last) / SAMPLED
        values = _sampled(held, held_from, time, timetable.offset) * timetable.gains(names, time)
        yield values + rng.normal(size=values.shape) * noise
        taken = last
        drop = max(int(last * RATE / SAMPLED) - 2 * REACH - held_from, 0)
        held, held_from = held[drop:], held_from + drop


def _place(timetable: Timetable, time: Array) -> Array:
    """Distance run, m, with the speed linear between points of the timetable."""
    step = timetable.time[1] - timetable.time[0]
    run = np.concatenate([[0.0], np.cumsum(0.5 * (timetable.speed[1:] + timetable.speed[:-1]) * step)])
    index = np.minimum((time / step).astype(int), len(run) - 2)
    inside = time - timetable.time[index]
    slope = (timetable.speed[index + 1] - timetable.speed[index]) / step
    return np.asarray(run[index] + timetable.speed[index] * inside + 0.5 * slope * inside**2)


def _wheels(vehicle: Vehicle, rails: Rails, place: Array, front: float) -> Array:
    """Displacements and velocities of the wheels, (T, 2 W)."""
    heights = np.stack(
        [
            rails.at(float(side), place + 30.0 - (front - x))
            for x, side in zip(vehicle.input_position, vehicle.input_side, strict=True)
        ],
        axis=1,
    )
    coefficients = ndimage.spline_filter1d(heights, order=3, axis=0, mode="mirror")
    slopes = np.gradient(coefficients, 1 / RATE, axis=0)  # of a cubic spline at its points: exact
    return np.hstack([heights, slopes])


def _outside(vehicle: Vehicle, timetable: Timetable, time: Array, rng: np.random.Generator) -> Array:
    """Roll and pitch moment and vertical force on the car: curves, braking, people who board, (T, 3)."""
    mass = vehicle.inertia[0] * (1 + timetable.at(timetable.load, time))
    roll = mass * timetable.at(timetable.lateral, time) * GRAVITY_HEIGHT
    pitch = -mass * timetable.at(timetable.acceleration, time) * GRAVITY_HEIGHT * 0.5
    steps = ndimage.gaussian_filter1d(rng.normal(size=len(time) + 200), 40.0)[100:-100]  # up to 4 Hz
    force = PEOPLE * steps / 0.084 * timetable.at(timetable.boarding, time)
    return np.stack([roll, pitch, force], axis=1)


def _sampled(held: Array, held_from: int, time: Array, offset: Array) -> Array:
    """Filtered channels at `time` less the offset of their clocks, (T, C)."""
    smooth = signal.oaconvolve(np.pad(held, ((80, 80), (0, 0)), mode="edge"), LOW_PASS[:, None], mode="valid", axes=0)
    out = np.empty((len(time), held.shape[1]))
    for late in np.unique(offset):
        columns = np.flatnonzero(offset == late)
        rows = (time - late) * RATE - held_from
        for column in columns:
            out[:, column] = ndimage.map_coordinates(smooth[:, column], [rows], order=3, mode="nearest")
    return out
