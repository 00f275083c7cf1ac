"""`sensing`: what every set of sensors that a train may have tells, against the best that any estimator could do.

Rides come from `benchmarks/generator` (harmonic by harmonic at 1 kHz, behind an anti-alias filter).  With sensors on
the axle boxes windows are a second long; every accelerometer has an offset of its own and drifts.  The bound is that of
`benchmarks/bounds`, in the time domain, with offsets unknown: neither rides nor bound use the product's likelihood.
Without sensors below, and with two accelerometers, windows are a minute long: see `benchmarks/ambient`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks import ambient
from sprung.benchmarks.bounds import time_domain_bound
from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.exact import VehicleTransfer, filtered
from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.vehicle import read_vehicle
from sprung.model.identification.identify import load_identifier
from sprung.model.system import BUNDLED, System, load_system

Array = NDArray[np.float64]

OFFSET = 0.1  # m/s^2, of an accelerometer on an axle box; a tenth of it elsewhere
DRIFT = 0.01  # m/s^2 per sqrt(s), likewise
SPREAD = 0.5  # elements within nominal (1 +- SPREAD)
SPEED = (30.0, 55.0)  # m/s


@dataclass(frozen=True)
class AxleBoxSensing:
    """A set of sensors with some on the axle boxes."""

    name: str
    file: str  # of the bundled systems
    orders: tuple[int, ...]  # derivatives of the wheels' motion that are measured


BELOW = (
    AxleBoxSensing("axle boxes: displacement and velocity", "manchester.yaml", (0, 1)),
    AxleBoxSensing("axle boxes: acceleration only", "axleboxes.yaml", (2,)),
)


def run(windows: int = 1200, bounds: int = 40, rides: int = 24, cases: int = 24, seed: int = 9000) -> Iterator[Any]:
    """One figure at a time.  `--windows 160 --bounds 12 --rides 4 --cases 2` takes minutes; 0 leaves a part out."""
    for below in BELOW if windows else ():
        yield from accuracy(below, windows, bounds, seed)
    if rides:
        yield from ambient.accuracy(rides, 60.0, seed)
    if cases:
        yield from ambient.isolation(cases, 60.0, seed)


def accuracy(below: AxleBoxSensing, count: int, bounds: int, seed: int) -> Iterator[dict[str, Any]]:
    """Error over the bound, coverage and speed with sensors on the axle boxes."""
    system = load_system(BUNDLED / below.file)
    rng = np.random.default_rng([seed, len(below.orders)])
    values, clean, truth = draw_windows(system, below.orders, count, rng)
    begin = time.process_time()
    estimates = load_identifier(system).identify(values)
    spent = time.process_time() - begin
    error = np.array([e.log_ratio for e in estimates]) - truth
    std = np.sqrt([np.diag(e.covariance) for e in estimates])
    identifiable = np.array([e.identifiable for e in estimates])
    chosen = np.flatnonzero(identifiable.all(axis=1))[:bounds]
    least = np.array([time_domain_bound(system, clean[i], truth[i], fused=True, offsets=True) for i in chosen])
    stated = np.sqrt((std[chosen] ** 2).mean(axis=0) / (least**2).mean(axis=0))
    for group, rows in {**ambient.GROUPS, "all 24": slice(0, 24)}.items():
        if group == "load":
            continue
        # The bound of all windows: that of some in the time domain, carried over by the stated deviations.
        e, s = error[:, rows][identifiable[:, rows]], std[:, rows][identifiable[:, rows]]
        bound = np.sqrt((s**2).mean() / (stated[rows] ** 2).mean())
        yield {
            "figure": "accuracy",
            "sensing": below.name,
            "parameters": group,
            "windows": count,
            "seconds": system.window / system.sample_rate,
            "rmse_percent": float(100 * np.sqrt(np.mean(e**2))),
            "bound_percent": float(100 * bound),
            "rmse_over_bound": float(np.sqrt(np.mean(e**2)) / bound),
            "identifiable": float(identifiable[:, rows].mean()),
            "error_over_std_rms": float(np.sqrt(np.mean((e / s) ** 2))),
            "coverage_95": float(np.mean(np.abs(e) < 1.96 * s)),
            "target": "<= 1.1, coverage 0.93-0.97",
        }
    yield {
        "figure": "windows",
        "sensing": below.name,
        "usable": float(np.mean([e.adequate and e.converged for e in estimates])),
        "chi_square": float(np.median([e.chi_square for e in estimates])),
        "cpu_milliseconds": 1e3 * spent / count,
        "bounds": len(chosen),
        "stated_over_bound": float(np.sqrt(np.mean(stated**2))),
    }


def draw_windows(
    system: System, orders: tuple[int, ...], count: int, rng: np.random.Generator, per_ride: int = 8
) -> tuple[Array, Array, Array]:
    """Measured windows (B, T, C), the same without noise and offsets, and log-ratios (B, P).

    Windows of one ride have the vehicle, its speed and its track in common and are a second apart.
    """
    vehicle = read_vehicle(SYSTEM)
    seconds = 2 * per_ride * system.window / system.sample_rate
    clean: list[Array] = []
    truth: list[Array] = []
    while len(clean) < count:
        ratio = rng.uniform(1 - SPREAD, 1 + SPREAD, 2 * len(vehicle.elements))
        level = np.exp(rng.uniform(np.log(track.LOW_TRACK), np.log(track.HIGH_TRACK)))
        spectra, omega, samples = track.wheel_spectra(
            rng, seconds, rng.uniform(*SPEED), level, vehicle.input_position, vehicle.input_side, own_share=0.05
        )
        live = np.flatnonzero(omega < 2 * np.pi * 50.0)
        k, c = np.split(ratio, 2)
        transfer = VehicleTransfer(vehicle, vehicle.stiffness * k, vehicle.damping * c, omega[live])
        ride = filtered(transfer, spectra[live], omega[live], samples, seconds, orders)
        wheels = len(vehicle.inputs)  # the generator lists all displacements first, the system wheel by wheel
        inputs = np.arange(len(orders) * wheels).reshape(len(orders), wheels).T.ravel()
        ride = ride[:, [*inputs, *range(len(orders) * wheels, ride.shape[1])]]
        clean += list(ride[: 2 * per_ride * system.window].reshape(per_ride, 2 * system.window, -1)[:, : system.window])
        truth += [np.log(ratio)] * per_ride
    whole, log_ratio = np.array(clean[:count]), np.array(truth[:count])
    noise = np.array([channel.noise for channel in system.channels])
    values = whole + noise * rng.standard_normal(whole.shape)
    return values + _offsets(system, orders, whole.shape, rng), whole, log_ratio


def _offsets(system: System, orders: tuple[int, ...], shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Offsets and slow drifts of the accelerometers, (B, T, C)."""
    below = len(system.inputs) if orders == (2,) else 0
    size = np.full(shape[2], 0.1)
    size[: len(system.inputs)] = 0.0
    size[:below] = 1.0
    steps = rng.standard_normal(shape) * DRIFT / np.sqrt(system.sample_rate)
    return np.asarray((OFFSET * rng.standard_normal((shape[0], 1, shape[2])) + np.cumsum(steps, axis=1)) * size)
