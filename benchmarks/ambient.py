"""Nothing measured below: accuracy of a minute of accelerometers against the Cramer-Rao bound, and how well a single
degraded spring or damper is found with two of them.

The rides come from `benchmarks/generator`, the bound from its transfer functions by finite differences: neither uses
the product's likelihood.  Speed, load, levels of the rails, coherence and every wheel's own share are unknown to all.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator.integrate import SAMPLE_RATE
from sprung.benchmarks.generator.ride import SYSTEM, DrawnRide, draw_ride, record, transfer
from sprung.benchmarks.generator.track import SHORTEST
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.model.ambient.identify import AmbientIdentifier
from sprung.model.system import BUNDLED, load_system

Array = NDArray[np.float64]

SENSORS = {  # rows of the bundled vehicle's sensors
    "12 accelerometers": list(range(12)),
    "2 car + 1 per bogie": [0, 3, 5, 10],
}
GROUPS = {  # of parameters: rows of stiffnesses, then of dampings, then the load
    "primary stiffness": slice(0, 8),
    "secondary stiffness": slice(8, 12),
    "primary damping": slice(12, 20),
    "secondary damping": slice(20, 24),
    "load": slice(24, 25),
}
LOWEST = 0.65  # Hz, where the bound's band begins
OCTAVES = np.log(2.0)
STEP = 1e-5  # of finite differences


def run(rides: int = 40, cases: int = 40, seconds: float = 60.0, seed: int = 9000) -> Iterator[dict[str, Any]]:
    """Both parts, one figure at a time."""
    if rides:
        yield from accuracy(rides, seconds, seed)
    if cases:
        yield from isolation(cases, seconds, seed)


def accuracy(rides: int, seconds: float, seed: int) -> Iterator[dict[str, Any]]:
    """Error over the bound, coverage of intervals, time; for every set of sensors."""
    system = load_system(BUNDLED / "accelerometers.yaml")
    vehicle = read_vehicle(SYSTEM)
    for name, rows in SENSORS.items():
        error, std, least, spent, fits, squares = [], [], [], [], [], []
        for number in range(rides):
            rng = np.random.default_rng([seed, number])
            ride = draw_ride(rng)
            values = np.full((round(seconds * SAMPLE_RATE), 12), np.nan)
            values[:, rows] = record(rng, ride, seconds)[:, rows]
            begin = time.process_time()
            fit = AmbientIdentifier(system).fit(values)
            spent.append(time.process_time() - begin)
            if fit is None:
                raise RuntimeError(f"ride {number} of seed {seed} determined nothing")
            error.append(fit.log_ratio - np.append(ride.log_ratio, ride.load))
            std.append(np.sqrt(np.diag(fit.covariance)))
            squares.append(error[-1] @ np.linalg.solve(fit.covariance, error[-1]) / len(error[-1]))
            least.append(bound(vehicle, ride, rows, seconds))
            fits.append(fit.chi_square)
        yield from _figures(name, rides, seconds, np.array(error), np.array(std), np.array(least))
        yield {
            "figure": "windows",
            "sensing": name,
            "cpu_seconds": float(np.median(spent)),
            "chi_square": float(np.median(fits)),
            # over the whole covariance: what the unknowns of a ride have in common counts once; 1 if all is as stated
            "error_squares": float(np.mean(squares)),
            "error_squares_std": float(np.sqrt(2 / (len(error[0]) * rides))),
            "speed": "unknown",
        }


def _figures(name: str, rides: int, seconds: float, error: Array, std: Array, least: Array) -> Iterator[dict[str, Any]]:
    everything = {**GROUPS, "all 24": slice(0, 24)}
    for group, rows in everything.items():
        e, s, b = error[:, rows], std[:, rows], least[:, rows]
        yield {
            "figure": "accuracy",
            "sensing": name,
            "parameters": group,
            "rides": rides,
            "seconds": seconds,
            "rmse_percent": float(100 * np.sqrt(np.mean(e**2))),
            "bound_percent": float(100 * np.sqrt(np.mean(b**2))),
            "bound_median_percent": float(100 * np.median(b)),
            "rmse_over_bound": float(np.sqrt(np.mean(e**2) / np.mean(b**2))),
            "error_over_bound_rms": float(np.sqrt(np.mean((e / b) ** 2))),
            "error_over_std_rms": float(np.sqrt(np.mean((e / s) ** 2))),
            "coverage_95": float(np.mean(np.abs(e) < 1.96 * s)),
        }


TWO = [0, 2]  # the two accelerometers: on the car, left over either bogie; of all pairs they tell all kinds apart best
SCATTER = 0.03  # of a healthy vehicle's values about nominal
LOOSE = 0.3  # standard deviation of every log-ratio while a window is fitted
MINUTES = 3  # of running that one verdict is made from
DAMAGE = (0.4, 0.8)  # of the healthy value that is left
PUBLISHED = {  # 10.1007/s40534-025-00422-3: isolated, mean and standard deviation of the size's error, per cent
    "primary": (94.0, 2.45, 2.92),
    "secondary": (99.0, 4.05, 3.66),
}


def isolation(cases: int, seconds: float, seed: int) -> Iterator[dict[str, Any]]:
    """One degraded spring or damper among twelve of each, from two accelerometers; speed and load unknown.

    Every hypothesis "this value, and no other, has left its healthy scatter" is judged by its evidence under the sum of
    the windows' information; loads, speeds and tracks are each window's own.
    """
    vehicle = read_vehicle(SYSTEM)
    names = [f"{e}.{q}" for q in ("stiffness", "damping") for e in vehicle.elements]
    found: dict[str, list[tuple[bool, bool, float, float]]] = {"primary": [], "secondary": []}
    for number in range(cases):
        rng = np.random.default_rng([seed, 1, number])
        stage = ("primary", "secondary")[number % 2]
        hit = int(rng.choice([i for i, name in enumerate(names) if name.startswith(stage)]))
        values = SCATTER * rng.normal(size=24)
        values[hit] += np.log(rng.uniform(*DAMAGE))
        said, size = verdict(rng, values, seconds)
        same_place = names[said].split(".")[0] == names[hit].split(".")[0]
        error = abs(size - np.exp(values[hit])) if said == hit else np.nan
        found[stage].append((said == hit, same_place, error, size_bound(vehicle, rng, values, hit, seconds)))
    for stage, seen in found.items():
        right, place, errors, least = (np.array(part) for part in zip(*seen, strict=True))
        yield {
            "figure": "isolation",
            "stage": stage,
            "cases": len(seen),
            "minutes": MINUTES * seconds / 60,
            "isolated_percent": float(100 * np.mean(right)),
            "element_percent": float(100 * np.mean(place)),
            "size_error_percent": [float(100 * np.nanmean(errors)), float(100 * np.nanstd(errors))],
            # mean and standard deviation of the absolute error of an estimator at the bound
            "size_bound_percent": [
                float(100 * np.mean(least) * np.sqrt(2 / np.pi)),
                float(100 * np.sqrt(np.mean(least**2) - 2 / np.pi * np.mean(least) ** 2)),
            ],
            "published": dict(zip(("isolated", "error_mean", "error_std"), PUBLISHED[stage], strict=True)),
        }


def size_bound(vehicle: Vehicle, rng: np.random.Generator, values: Array, hit: int, seconds: float) -> float:
    """Standard deviation of what is left of a value that no unbiased estimator can beat, from `MINUTES` rides such as
    those of a verdict, where it is known which value has changed and the others lie within their scatter."""
    known = _changed(hit)
    known[hit] = 0.0
    whole = np.diag(known)
    for _ in range(MINUTES):
        ride = replace(draw_ride(rng), log_ratio=values)
        whole += np.linalg.inv(bound_covariance(vehicle, ride, TWO, seconds)[:24, :24])
    return float(np.exp(values[hit]) * np.sqrt(np.linalg.inv(whole)[hit, hit]))


def verdict(rng: np.random.Generator, values: Array, seconds: float) -> tuple[int, float]:
    """Which of the 24 values has changed, and what of its nominal value is left.

    Windows are fitted with all values open; what is left is then fitted once more with only the changed one open, as
    what windows say is linear near their fit alone.
    """
    identifier = AmbientIdentifier(load_system(BUNDLED / "accelerometers.yaml"))
    windows = []
    for _ in range(MINUTES):
        ride = replace(draw_ride(rng), log_ratio=values)
        windows.append(np.full((round(seconds * SAMPLE_RATE), 12), np.nan))
        windows[-1][:, TWO] = record(rng, ride, seconds)[:, TWO]
    information, pull = _together(identifier, windows, np.full(24, LOOSE), np.zeros(24))
    evidence = []
    for i in range(24):
        prior = _changed(i)
        whole = information + np.diag(prior)
        mean = np.linalg.solve(whole, pull)
        evidence.append(0.5 * (pull @ mean - np.linalg.slogdet(whole)[1] + np.log(prior).sum()))
    best = int(np.argmax(evidence))
    prior = _changed(best)
    near = np.asarray(np.linalg.solve(information + np.diag(prior), pull), dtype=np.float64)
    information, pull = _together(identifier, windows, prior**-0.5, near)
    return best, float(np.exp(np.linalg.solve(information + np.diag(prior), pull)[best]))


def _changed(hit: int) -> Array:
    """Precision of the 24 log-ratios where one has changed and the others have not."""
    prior = np.full(24, SCATTER**-2.0)
    prior[hit] = 1.0
    return prior


def _together(identifier: AmbientIdentifier, windows: list[Array], std: Array, start: Array) -> tuple[Array, Array]:
    """Information of windows on the 24 log-ratios, and that times their mean, beyond the prior `std` of each fit."""
    identifier.window.prior_std[:24] = std
    information, pull = np.zeros((24, 24)), np.zeros(24)
    for values in windows:
        fit = identifier.fit(values, start if start.any() else None)
        if fit is not None:
            precision = np.linalg.inv(fit.covariance[:24, :24])
            information += precision - np.diag(std**-2.0)
            pull += precision @ fit.log_ratio[:24]
    return information, pull


def bound(vehicle: Vehicle, ride: DrawnRide, sensors: list[int], seconds: float) -> Array:
    """Standard deviations (24 parameters, load) that no unbiased estimator can beat, for a stationary record."""
    return np.asarray(np.sqrt(np.diag(bound_covariance(vehicle, ride, sensors, seconds))))


def bound_covariance(vehicle: Vehicle, ride: DrawnRide, sensors: list[int], seconds: float) -> Array:
    """Covariance (25, 25) of 24 parameters and the load that no unbiased estimator can beat, for a stationary record.

    Slepian-Bangs: F_ij = T integral over f of tr S^-1 dS/dx_i S^-1 dS/dx_j, everything else free: two levels and one
    coherence per octave, a share of its own for every wheel, the speed.
    """
    top = SHORTEST * ride.speed / (2 * np.pi)
    frequency = np.linspace(LOWEST, top * 0.99, 400)
    x = np.concatenate([ride.log_ratio, [ride.load], _nuisances(ride, frequency, len(vehicle.inputs))])

    still = _response(vehicle, ride, x, frequency)

    def spectrum(at: Array) -> NDArray[np.complex128]:
        same = np.array_equal(at[:25], x[:25])
        A = still if same else _response(vehicle, ride, at, frequency)
        return _spectrum(vehicle, ride, at, frequency, A)[:, sensors][:, :, sensors]

    S = spectrum(x)
    inverse = np.linalg.inv(np.linalg.cholesky(S))
    slopes = []
    for i in range(len(x)):
        step = np.zeros(len(x))
        step[i] = STEP
        slope = (spectrum(x + step) - spectrum(x - step)) / (2 * STEP)
        slopes.append((inverse @ slope @ inverse.conj().swapaxes(1, 2)).reshape(-1))
    rows = np.array(slopes)
    information = (rows @ rows.conj().T).real * seconds * (frequency[1] - frequency[0])
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(covariance[:25, :25])


def _octaves(frequency: Array) -> Array:
    """Hat functions over log-frequency, an octave apart, (F, nodes)."""
    count = 1 + int(np.ceil(np.log(frequency[-1] / frequency[0]) / OCTAVES))
    place = np.log(frequency / frequency[0])[:, None] / OCTAVES - np.arange(count)
    return np.asarray(np.maximum(1 - np.abs(place), 0.0))


def _nuisances(ride: DrawnRide, frequency: Array, wheels: int) -> Array:
    """Truth of [levels left, levels right (relative, log), coherence per octave, own shares, log-speed]."""
    count = _octaves(frequency).shape[1]
    return np.concatenate([np.zeros(2 * count), np.full(count, ride.coherence), np.full(wheels, ride.own_share), [0.0]])


def _response(vehicle: Vehicle, ride: DrawnRide, x: Array, frequency: Array) -> NDArray[np.complex128]:
    """Sensors per wheel, (F, S, wheels)."""
    loaded = replace(ride, log_ratio=x[:24], load=float(x[24]))
    return np.asarray(transfer(vehicle, loaded, 2 * np.pi * frequency).to_sensors)


def _spectrum(
    vehicle: Vehicle, ride: DrawnRide, x: Array, frequency: Array, A: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Spectral matrix of the sensors, in the units of a sample's variance, (F, S, S)."""
    hats, omega = _octaves(frequency), 2 * np.pi * frequency
    count, wheels = hats.shape[1], len(vehicle.inputs)
    left, right, coherence = (hats @ part for part in x[25 : 25 + 3 * count].reshape(3, count))
    share = x[25 + 3 * count : 25 + 3 * count + wheels]
    size = np.where(vehicle.input_side > 0, np.exp(left / 2)[:, None], np.exp(right / 2)[:, None])
    delay = np.exp(1j * omega[:, None] * vehicle.input_position / (ride.speed * np.exp(x[-1])))
    across = vehicle.input_side[:, None] != vehicle.input_side[None, :]
    alike = np.where(across, coherence[:, None, None], 1.0) * np.sqrt(np.outer(1 - share, 1 - share))
    wheel = (size * delay)[:, :, None] * alike * (size * delay).conj()[:, None, :]
    wheel = wheel + (size**2)[:, :, None] * np.diag(share)
    level = ride.level_at(omega)[:, None, None] * SAMPLE_RATE / 2
    return np.asarray(A @ (level * wheel) @ A.conj().swapaxes(1, 2) + np.diag(vehicle.sensor_noise**2))
