"""One smooth motion from a measured displacement and a measured velocity of the same point.

Both samples carry noise, and the velocity is the derivative of the displacement: the least-squares cubic spline
with a knot at every sample, fitted to both with their noises as weights, uses the displacement at low and the
velocity at high frequencies.  Its power spectral density of error is

    s(w)^2 = 1 / (1 / sd^2 + |D(w)|^2 / sv^2),    D(w) = j sin(w h) / h / (2/3 + cos(w h) / 3)  (about j w)

A cubic spline is its own Hermite interpolant, so the simulator takes its values and slopes as they are.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import solveh_banded

from model.signals import FloatArray

# Cubic B-spline at its knots: values 1/6, 4/6, 1/6 and slopes -1/2, 0, 1/2 (over h).
_VALUE = np.array([1.0, 4.0, 1.0]) / 6
_SLOPE = np.array([-1.0, 0.0, 1.0]) / 2
_DENSE = 512  # samples up to which the smoother is kept as a matrix


def fuse(
    displacement: FloatArray, velocity: FloatArray, dt: float, noise: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Smoothed displacement and velocity, same shapes as given: (..., T)."""
    T = displacement.shape[-1]
    if T <= _DENSE:
        matrix = _smoother(T, dt, *noise)
        both = np.concatenate([displacement, velocity], axis=-1) @ matrix.T
        return both[..., :T], both[..., T:]
    flat = np.concatenate([displacement, velocity], axis=-1).reshape(-1, 2 * T).T
    both = _solve(flat, T, dt, *noise).T.reshape(*displacement.shape[:-1], 2 * T)
    return both[..., :T], both[..., T:]


def fused_noise(omega: FloatArray, dt: float, noise: tuple[float, float]) -> FloatArray:
    """Standard deviation per sample of the fused displacement at angular frequencies omega."""
    derivative = np.sin(omega * dt) / dt / (2 / 3 + np.cos(omega * dt) / 3)
    return 1 / np.sqrt(1 / noise[0] ** 2 + derivative**2 / noise[1] ** 2)


@lru_cache(maxsize=32)
def _smoother(T: int, dt: float, sd: float, sv: float) -> FloatArray:
    matrix = _solve(np.eye(2 * T), T, dt, sd, sv)
    matrix.setflags(write=False)
    return matrix


def _solve(data: FloatArray, T: int, dt: float, sd: float, sv: float) -> FloatArray:
    """Normal equations of the spline's T + 2 coefficients (7 diagonals at most); data (2T, X) to (2T, X)."""
    value, slope = _VALUE, _SLOPE / dt
    band = np.zeros((3, T + 2))  # upper form: band[2 - j] is the j-th diagonal
    load = np.zeros((T + 2, data.shape[1]))
    for weights, rows, sigma in ((value, data[:T], sd), (slope, data[T:], sv)):
        for i in range(3):
            load[i : i + T] += weights[i] / sigma**2 * rows
            for j in range(i, 3):
                band[2 - (j - i), j : j + T] += weights[i] * weights[j] / sigma**2
    coefficients = solveh_banded(band, load)
    out = np.zeros_like(data)
    for i in range(3):
        out[:T] += value[i] * coefficients[i : i + T]
        out[T:] += slope[i] * coefficients[i : i + T]
    return out
