"""Many vehicles at once through a fixed-step Runge-Kutta method of order 4 at 2 kHz, filtered and decimated.

Columns are recordings (B).  Every signal, inputs included, passes the same linear-phase low-pass before decimation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.generator.track import RATE as TABLE_RATE
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]

STEP_RATE = 2000.0  # Hz
SAMPLE_RATE = 100.0  # Hz
WARM_UP = 5.0  # s before the first sample; time-varying laws start there
DECIMATE = int(STEP_RATE / SAMPLE_RATE)
TAPS = 401
LOW_PASS = signal.firwin(TAPS, 43.5, window=("kaiser", 6.0), fs=STEP_RATE)
MODE_MASS = 8000.0  # kg


@dataclass
class Slot:
    """One effect on one element of one recording."""

    column: int
    element: int
    law: str
    parameters: list[float]


@dataclass
class PlantBatch:
    """What differs between the recordings of a batch."""

    stiffness: Array  # N/m, shape (E, B)
    damping: Array  # N s/m, shape (E, B)
    inertia: Array  # shape (D, B)
    mode: Array  # [frequency Hz, damping ratio, shape at the springs, 1 if the car has one], shape (4, B)
    drive: Array  # [amplitude N, frequency Hz, degree of freedom, phase], shape (4, B)
    slots: list[Slot]


class BatchMotion:
    """The equations of motion of a batch, with buffers reused from step to step."""

    def __init__(self, vehicle: Vehicle, plant: PlantBatch) -> None:
        self.vehicle, self.plant = vehicle, plant
        elements, batch = plant.stiffness.shape
        n = self.degrees = vehicle.inertia.size
        wheels = len(vehicle.inputs)
        # One product gives deflections and rates: columns are [z, mode, z', mode', w, w'].
        self.stretch = np.zeros((2 * elements, 2 * (n + 1) + 2 * wheels))
        for half in (0, 1):
            rows = slice(half * elements, (half + 1) * elements)
            self.stretch[rows, half * (n + 1) : half * (n + 1) + n] = vehicle.geometry
            for row, wheel in enumerate(vehicle.support):
                if wheel >= 0:
                    self.stretch[half * elements + row, 2 * (n + 1) + half * wheels + wheel] = -1.0
        self.both = np.empty((self.stretch.shape[1], batch))
        self.pull = -vehicle.geometry.T
        self.shape = np.zeros((elements, batch))
        on_car = [row for row, upper in enumerate(vehicle.upper) if upper == vehicle.bodies[0]]
        self.shape[on_car] = plant.mode[2] * plant.mode[3]
        self.felt_by = [i for i, body in enumerate(vehicle.sensor_body) if body == vehicle.bodies[0]]
        self.bends = bool(plant.mode[3].any())
        self.omega = 2 * np.pi * plant.mode[0]
        self.driven = np.flatnonzero(plant.drive[0])
        self.drive = plant.drive[:, self.driven]
        self.first = (np.zeros((elements, batch)), np.zeros(0))  # linear and law forces at the start of a step
        self._group()

    def _group(self) -> None:
        given = self.plant.slots
        self.order = sorted(range(len(given)), key=lambda i: given[i].law)
        slots = [given[i] for i in self.order]
        self.row = np.array([s.element for s in slots], int)
        self.column = np.array([s.column for s in slots], int)
        self.k = self.plant.stiffness[self.row, self.column]
        self.c = self.plant.damping[self.row, self.column]
        self.groups = []
        for name in sorted({s.law for s in slots}):
            which = [i for i, s in enumerate(slots) if s.law == name]
            span = slice(which[0], which[-1] + 1)
            self.groups.append((LAWS[name], span, np.array([slots[i].parameters for i in which]).T))
        self.extra = np.zeros(len(slots))

    def __call__(self, state: Array, memory: Array, support: Array, time: float) -> tuple[Array, Array]:
        """Rates of the state [z, mode, z', mode'] (2 D + 2, B) and of the memories (slots,).

        `support` holds the wheels' displacements and velocities, shape (2 wheels, B).
        """
        n, elements = self.degrees, len(self.shape)
        self.both[: 2 * n + 2], self.both[2 * n + 2 :] = state, support
        strain = self.stretch @ self.both
        deflection, rate = strain[:elements], strain[elements:]
        if self.bends:
            deflection += self.shape * state[n]
            rate += self.shape * state[2 * n + 1]
        self.linear = self.plant.stiffness * deflection
        self.linear += self.plant.damping * rate
        memory_rate = self._laws(deflection, rate, memory, time)
        force = self.linear.copy()
        np.add.at(force, (self.row, self.column), self.extra)  # of an element with two laws, both
        out = np.empty_like(state)
        out[: n + 1] = state[n + 1 :]
        push = self.pull @ force
        if self.driven.size:
            amplitude, frequency, degree, phase = self.drive
            push[degree.astype(int), self.driven] += amplitude * np.sin(2 * np.pi * frequency * time + phase)
        np.divide(push, self.plant.inertia, out=out[n + 1 : 2 * n + 1])
        out[2 * n + 1] = 0.0
        if self.bends:
            out[2 * n + 1] = (
                -(self.shape * force).sum(0) / MODE_MASS
                - 2 * self.plant.mode[1] * self.omega * state[2 * n + 1]
                - self.omega**2 * state[n]
            )
        return out, memory_rate

    def _laws(self, deflection: Array, rate: Array, memory: Array, time: float) -> Array:
        d, v = deflection[self.row, self.column], rate[self.row, self.column]
        memory_rate = np.zeros_like(memory)
        for law, span, p in self.groups:
            result = law.force(d[span], v[span], p, self.k[span], self.c[span], time, memory[span])
            if law.memory:
                self.extra[span], memory_rate[span] = result
            else:
                self.extra[span] = result
        return memory_rate

    def accelerations(self, rate: Array) -> Array:
        """What the accelerometers feel, shape (S, B), from the rates of the state."""
        n = self.degrees
        felt = self.vehicle.pickup @ rate[n + 1 : 2 * n + 1]
        felt[self.felt_by] += self.plant.mode[2] * self.plant.mode[3] * rate[2 * n + 1]
        return felt


def _hermite(displacement: Array, velocity: Array, first: int, count: int) -> Array:
    """Cubic Hermite between table points: `count` half steps from half step `first`, (count, 2 wheels, B)."""
    per_cell = int(2 * STEP_RATE / TABLE_RATE)
    index = np.arange(first, first + count)
    cell, u = index // per_cell, (index % per_cell / per_cell)[:, None, None]
    h = 1 / TABLE_RATE
    x0, x1, v0, v1 = displacement[cell], displacement[cell + 1], velocity[cell] * h, velocity[cell + 1] * h
    delta = x1 - x0
    a, b = 3 * delta - 2 * v0 - v1, v0 + v1 - 2 * delta
    return np.concatenate([x0 + u * (v0 + u * (a + u * b)), (v0 + u * (2 * a + u * 3 * b)) / h], axis=1)


def simulate(
    vehicle: Vehicle,
    plant: PlantBatch,
    displacement: Array,
    velocity: Array,
    seconds: float,
    progress: Callable[[float], None] | None = None,
) -> tuple[Array, Array]:
    """Filtered samples at 100 Hz, shape (T, 2 wheels + S, B), and each slot's strength, shape (slots,).

    `displacement` and `velocity` are tables at 1 kHz, shape (N, wheels, B), that start WARM_UP before the first
    sample.  The strength of a slot is the rms of its law's force over the rms of k d + c v.
    """
    motion = BatchMotion(vehicle, plant)
    batch, wheels, sensors = plant.stiffness.shape[1], len(vehicle.inputs), len(vehicle.sensors)
    state = np.zeros((2 * motion.degrees + 2, batch))
    memory = np.zeros(len(plant.slots))
    samples = round(seconds * SAMPLE_RATE)
    half = TAPS // 2
    chunk = int(STEP_RATE)
    chunks = int(np.ceil(WARM_UP + seconds + half / STEP_RATE + 1 / SAMPLE_RATE))
    tail = np.zeros((TAPS - 1, (2 * wheels + sensors) * batch))
    kept: list[Array] = []
    power = np.zeros((2, len(plant.slots)))
    rows = DECIMATE * np.arange(chunk // DECIMATE)
    toeplitz = np.zeros((rows.size, TAPS - 1 + chunk))
    for i, start in enumerate(rows):
        toeplitz[i, start : start + TAPS] = LOW_PASS
    for number in range(chunks):
        support = _hermite(displacement, velocity, number * 2 * chunk, 2 * chunk + 1)
        fast = np.empty((chunk, 2 * wheels + sensors, batch))
        fast[:, : 2 * wheels] = support[:-1:2]
        for step in range(chunk):
            time = number + step / STEP_RATE
            state, memory, fast[step, 2 * wheels :] = _advance(
                motion, state, memory, support[2 * step : 2 * step + 3], time
            )
            if step % DECIMATE == 0 and number >= WARM_UP:
                power += _power(motion)
        block = np.vstack([tail, fast.reshape(chunk, -1)])
        kept.append(toeplitz @ block)
        tail = block[-(TAPS - 1) :]
        if progress:
            progress((number + 1) / chunks)
    # Row i of a chunk sees the samples up to its start; the filter's centre lies `half` steps earlier.
    stream = np.concatenate(kept)
    first_row = round(WARM_UP * SAMPLE_RATE) + half // DECIMATE
    out = stream[first_row : first_row + samples].reshape(samples, 2 * wheels + sensors, batch)
    strength = np.empty(len(plant.slots))
    strength[motion.order] = np.sqrt(power[0] / np.maximum(power[1], 1e-30))
    return out, strength


def _advance(
    motion: BatchMotion, state: Array, memory: Array, support: Array, time: float
) -> tuple[Array, Array, Array]:
    """One step from the supports at its start, middle and end, (3, 2 wheels, B); also what was felt at its start."""
    h = 1 / STEP_RATE
    k1, m1 = motion(state, memory, support[0], time)
    felt = motion.accelerations(k1)
    motion.first = (motion.linear, motion.extra.copy())
    k2, m2 = motion(state + h / 2 * k1, memory + h / 2 * m1, support[1], time + h / 2)
    k3, m3 = motion(state + h / 2 * k2, memory + h / 2 * m2, support[1], time + h / 2)
    k4, m4 = motion(state + h * k3, memory + h * m3, support[2], time + h)
    k2 += k3
    k2 *= 2
    k2 += k1
    k2 += k4
    return state + h / 6 * k2, memory + h / 6 * (m1 + 2 * (m2 + m3) + m4), felt


def _power(motion: BatchMotion) -> Array:
    """Squares of the laws' forces and of the linear forces at the start of a step, shape (2, slots)."""
    linear, extra = motion.first
    return np.stack([extra**2, linear[motion.row, motion.column] ** 2])
