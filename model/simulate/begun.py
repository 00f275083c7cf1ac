"""The state in which a recording begins: the one from which a simulated ride comes nearest to it."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from sprung.model.laws import ElementLaw
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import Ride, simulate_ride
from sprung.model.system import System

_STRETCHES = 0.25, 0.7, 2.0  # s; in the first, stops are met a few times at most
_ROUNDS = 3  # slopes in a stretch, at most
_STEPS = 4  # with the same slopes, at most
_DIFFERENCE = 1e-3  # of the rms motion, for slopes
_GAINED = 0.01  # of the squares of the error: less is the end of a stretch
_HELD = 1e-4  # relative regularisation: states that a short stretch does not determine are kept


def fitted_start(system: System, inputs: FloatArray, measured: FloatArray) -> FloatArray:
    """The initial state (N,) with which a simulation comes nearest to the sensors.

    inputs: (T, I); measured: (T, S), NaN where missing.  Weighted least squares over the linear system's free motion.
    Where laws act along elements, Gauss-Newton with the laws follows over a first stretch, then over longer ones: a
    body that begins far inside a stop is thrown, and a long ride says little of where it began.
    """
    start = _of_free_motion(system, inputs, measured)
    if any(isinstance(law.law, ElementLaw) for law in system.laws):
        for seconds in _STRETCHES:
            some = slice(0, max(round(seconds * system.sample_rate), 4))
            start = _improved(system, inputs[some], measured[some], start)
    return start


def _of_free_motion(system: System, inputs: FloatArray, measured: FloatArray) -> FloatArray:
    """By the linear system's free motion, beside a ride from rest."""
    A, _, C, _ = system.mechanics.matrices()
    step = scipy.linalg.expm(A / system.sample_rate)
    lowest = max(float(np.abs(np.linalg.eigvals(A).real).min()), 1e-3)
    count = int(min(len(inputs), max(4 / lowest * system.sample_rate, 4 * len(A))))
    rows, power = np.empty((count, len(C), len(A))), np.eye(len(A))
    for k in range(count):
        rows[k] = C @ power
        power = step @ power
    error = _error(system, simulate_ride(system, inputs), measured)[:count]
    present = np.isfinite(error)
    design = (rows / system.sensor_noise[:, None])[present]
    scale = np.linalg.norm(design, axis=0)
    solution, *_ = np.linalg.lstsq(design / np.where(scale > 0, scale, 1.0), error[present], rcond=1e-10)
    start: FloatArray = solution / np.where(scale > 0, scale, 1.0)
    return start


def _improved(system: System, inputs: FloatArray, measured: FloatArray, start: FloatArray) -> FloatArray:
    """A start from which a stretch is met at least as well."""
    present = np.isfinite(measured)

    def error_from(state: FloatArray) -> FloatArray:
        return _error(system, simulate_ride(system, inputs, start=state), measured)[present]

    size = _usual_motion(system, inputs)
    error = error_from(start)
    for _ in range(_ROUNDS):
        before = error @ error
        moved = [error_from(start + _DIFFERENCE * own) for own in np.diag(size)]  # (N, K)
        slopes = (np.array(moved) - error).T / _DIFFERENCE
        products = slopes.T @ slopes
        products += _HELD * np.diag(products).max() * np.eye(len(start))
        for _ in range(_STEPS):
            step = -size * np.linalg.solve(products, slopes.T @ error)
            shorter = (step * share for share in (1.0, 0.3, 0.1))
            there = next((t for t in ((start + s, error_from(start + s)) for s in shorter) if _less(t[1], error)), None)
            if there is None:
                break
            start, error = there
        if not error @ error < (1 - _GAINED) * before:
            break
    return start


def _less(new: FloatArray, old: FloatArray) -> bool:
    """Whether an error is smaller by more than nothing; one that is not finite is not."""
    return bool(new @ new < (1 - _GAINED) * (old @ old))


def _usual_motion(system: System, inputs: FloatArray) -> FloatArray:
    """rms of every state along a ride from rest, (N,); one that hardly moves has a tenth of the largest."""
    states = simulate_ride(system, inputs).states
    n = system.mechanics.n
    states = np.hstack([states[:, :n], states[:, states.shape[1] // 2 :][:, :n]])  # without those of laws of bodies
    size = np.sqrt(np.mean(states**2, axis=0))
    halves = [np.maximum(half, 0.1 * half.max(initial=0.0) + 1e-12) for half in np.split(size, 2)]
    return np.concatenate(halves)


def _error(system: System, ride: Ride, measured: FloatArray) -> FloatArray:
    """Measured less simulated, in the sensors' noise, (T, S)."""
    found: FloatArray = (measured - ride.sensors) / system.sensor_noise
    return found
