"""Fusion of measured displacement, velocity and acceleration of a point into one smooth motion.

All samples carry noise, and one signal is the derivative of the other: the least-squares quintic spline with a knot at
every sample, fitted to all of them with their noises as weights, uses the displacement at low and the acceleration at
high frequencies.  Its error has the standard deviation per sample

    s(w) = 1 / sqrt(sum over q of |D_q(w)|^2 / s_q^2)

with D_q(w) the spline's q-th derivative over its value, (j w)^q to 0.1 % up to a quarter of the sample rate.  (A cubic
spline's first is 0.7 % off at an eighth of it, which biased dampings by a tenth of a standard deviation.)

What is known up to an integral only is integrated, and the constant, line or parabola that this leaves open is taken
out: the free motion of the vehicle, and the offset that every sensor may have, take it up exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded

from sprung.model.signals import FloatArray

# Quintic B-spline at its knots: values, slopes (over h) and curvatures (over h^2).
_SHAPE = np.array([[1.0, 26.0, 66.0, 26.0, 1.0], [-5.0, -50.0, 0.0, 50.0, 5.0], [20.0, 40.0, -120.0, 40.0, 20.0]]) / 120
_SPAN = _SHAPE.shape[1]
_DENSE = 512  # samples up to which a linear map is kept as a matrix

Noises = Mapping[int, float]  # standard deviation of one sample, by the derivative that is measured (0, 1, 2)


def used(noise: Noises) -> tuple[int, ...]:
    """The measured derivatives used for the motion: all that carry noise, or only the exact ones."""
    exact = tuple(order for order, std in sorted(noise.items()) if std <= 0)
    return exact or tuple(sorted(noise))


def motion(measured: Mapping[int, FloatArray], dt: float, noise: Noises) -> tuple[FloatArray, FloatArray]:
    """Displacement and velocity at the samples, each (..., T), from the derivatives `measured` (..., T) by order."""
    orders = used(noise) if set(noise) != {0, 1} or min(noise.values()) > 0 else (0, 1)
    key = tuple((order, float(noise[order])) for order in orders)
    T = measured[orders[0]].shape[-1]
    rows = np.concatenate([measured[order] for order in orders], axis=-1)
    if T <= _DENSE:
        both = rows @ _map(T, dt, key).T
    else:
        both = _motion(rows.reshape(-1, rows.shape[-1]).T, T, dt, key).T.reshape(*rows.shape[:-1], 2 * T)
    return both[..., :T], both[..., T:]


def motion_noise(omega: FloatArray, dt: float, noise: Noises) -> FloatArray:
    """Standard deviation, m per sample, of that displacement at omega (F,) > 0, rad/s; 0 where it is exact."""
    if min(noise[order] for order in used(noise)) <= 0:
        return np.zeros(len(omega))
    return np.asarray(1 / np.sqrt(_precision(omega, dt, noise).sum(axis=0)))


def motion_shares(omega: FloatArray, dt: float, noise: Noises) -> dict[int, FloatArray]:
    """Share (F,) of every measured derivative in that displacement at omega (F,) > 0, rad/s, by order."""
    orders = used(noise)
    if noise[orders[0]] <= 0:
        return {order: np.full(len(omega), float(order == orders[0])) for order in noise}
    precision = _precision(omega, dt, noise)
    return dict(zip(orders, precision / precision.sum(axis=0), strict=True))


def left_by_motion(measured: FloatArray, dt: float, key: tuple[tuple[int, float], ...]) -> FloatArray:
    """What the fit leaves of several derivatives (B, T, Q), in units of their noise.

    key: of every column, which derivative it is and its noise, in ascending order.
    """
    B, T, Q = measured.shape
    if T * Q <= 2 * _DENSE:
        rows = np.moveaxis(measured, 1, 2).reshape(B, Q * T) @ _leaving(T, dt, key)
        return np.asarray(np.moveaxis(rows.reshape(B, Q, T), 1, 2))
    columns = np.moveaxis(measured, 0, 2)  # (T, Q, B)
    lowest = key[0][0]
    shifted = {order - lowest: (columns[:, i] * std, std) for i, (order, std) in enumerate(key)}
    coefficients = _coefficients(shifted, T, dt)
    fitted = [_shown(coefficients, order - lowest, T, dt) / std for order, std in key]
    return np.asarray(np.moveaxis(columns - np.stack(fitted, axis=1), 2, 0))


@lru_cache(maxsize=32)
def _leaving(T: int, dt: float, key: tuple[tuple[int, float], ...]) -> FloatArray:
    """The projection that leaves it, (Q T, Q T), of columns one below the other."""
    lowest = key[0][0]
    unit = np.eye(T + _SPAN - 1)
    design = np.concatenate([_shown(unit, order - lowest, T, dt) / std for order, std in key])
    basis, _ = np.linalg.qr(design)
    found: FloatArray = np.eye(len(design)) - basis @ basis.T
    found.setflags(write=False)
    return found


def _precision(omega: FloatArray, dt: float, noise: Noises) -> FloatArray:
    """Information of every used derivative on the displacement, (orders, F)."""
    orders = used(noise)
    lowest = orders[0]  # what is integrated is so exactly; the spline differentiates
    factors = [omega**lowest * _derivative(omega, dt, order - lowest) for order in orders]
    return np.array([(f / noise[order]) ** 2 for f, order in zip(factors, orders, strict=True)])


def _derivative(omega: FloatArray, dt: float, order: int) -> FloatArray:
    """Size of the spline's derivative over its value; (omega)^order where it is exact."""
    phase = np.exp(1j * np.outer(omega * dt, np.arange(_SPAN) - _SPAN // 2))
    return np.asarray(np.abs(phase @ _SHAPE[order]) / np.abs(phase @ _SHAPE[0]) / dt**order)


@lru_cache(maxsize=32)
def _map(T: int, dt: float, key: tuple[tuple[int, float], ...]) -> FloatArray:
    """Matrix (2T, orders T)."""
    matrix = _motion(np.eye(len(key) * T), T, dt, key)
    matrix.setflags(write=False)
    return matrix


def _motion(data: FloatArray, T: int, dt: float, key: tuple[tuple[int, float], ...]) -> FloatArray:
    """Displacements and velocities (2T, X) from samples of the derivatives one below the other, (orders T, X)."""
    lowest = key[0][0]
    parts = [data[i * T : (i + 1) * T] for i in range(len(key))]
    if len(parts) > 1 and min(std for _, std in key) > 0:
        shifted = {order - lowest: (part, std) for (order, std), part in zip(key, parts, strict=True)}
        parts = list(_smoothed(shifted, T, dt))
    time = dt * np.arange(T)
    if lowest == 0:
        slope = parts[1] if len(parts) > 1 else CubicSpline(time, parts[0])(time, 1)
        return np.concatenate([parts[0], slope])
    spline = make_interp_spline(time, parts[0], k=5)
    once = spline.antiderivative()
    d, v = (once.antiderivative()(time), once(time)) if lowest == 2 else (once(time), parts[0])
    # What the integrals leave open: a constant, a line or a parabola.
    at = np.linspace(-1, 1, T)
    size = np.linalg.lstsq(np.vander(at, lowest + 1, increasing=True), d, rcond=None)[0]
    slopes = np.vander(at, lowest, increasing=True) * np.arange(1, lowest + 1) * (2 / (T - 1) / dt)
    moved = np.zeros_like(v) if lowest == 1 else slopes @ size[1:]
    return np.concatenate([d - np.vander(at, lowest + 1, increasing=True) @ size, v - moved])


def _smoothed(measured: dict[int, tuple[FloatArray, float]], T: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Value and slope (T, X) each of the spline that fits derivatives (T, X) with their noises."""
    coefficients = _coefficients(measured, T, dt)
    return _shown(coefficients, 0, T, dt), _shown(coefficients, 1, T, dt)


def _shown(coefficients: FloatArray, order: int, T: int, dt: float) -> FloatArray:
    """A derivative (T, X) of splines (T + 4, X) at the samples."""
    return np.asarray(sum(_SHAPE[order, i] / dt**order * coefficients[i : i + T] for i in range(_SPAN)))


def _coefficients(measured: dict[int, tuple[FloatArray, float]], T: int, dt: float) -> FloatArray:
    """Of the spline that fits derivatives (T, X) with their noises, (T + 4, X)."""
    last = _SPAN - 1
    band = np.zeros((_SPAN, T + last))  # upper form: band[last - j] is the j-th diagonal
    columns = next(iter(measured.values()))[0].shape[1]
    load = np.zeros((T + last, columns))
    for order, (rows, sigma) in measured.items():
        weights = _SHAPE[order] / dt**order
        for i in range(_SPAN):
            load[i : i + T] += weights[i] / sigma**2 * rows
            for j in range(i, _SPAN):
                band[last - (j - i), j : j + T] += weights[i] * weights[j] / sigma**2
    return np.asarray(solveh_banded(band, load))
