"""Loads from air-spring pressures.

The pressure of an air spring is proportional to the weight on it: log p = a + log(loaded mass / empty mass).  The
constant a is learned: every ride between two stops gives one value of it, from the load that the windows alone
determine.  Afterwards the pressure at a departure is the prior of the load, which is then known from the first window.

L loads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import BoolArray, FloatArray, IntArray

GAUGE = 0.015  # of a pressure: hysteresis of levelling valves and the gauge
KNOWN = 0.03  # standard deviation of a ride's load, within which it says something of a gauge that is off by 0.015
UNKNOWN = 1e6  # variance of a constant before the first ride
MEMORY = 0.05  # weight of the newest window's pressure in the mean of a ride
CONTRADICTION = 4.0  # standard deviations between windows and a pressure from which on the pressure is discarded
GAUGE_LIMIT = 3.0  # standard deviations of one ride beyond which the gauge is less accurate than stated
SCATTER_MEMORY = 0.3  # weight of the newest ride in the additional variance of a gauge


@dataclass(frozen=True, slots=True, eq=False)
class Cargo:
    """Constants of the pressures, the current ride, and the last load of an earlier one."""

    constant: FloatArray  # a, shape (L,)
    variance: FloatArray  # of it, shape (L,)
    pressure: FloatArray  # logarithm of the mean pressure of this ride, NaN: none, shape (L,)
    prior: FloatArray  # of the load's logarithm at departure, shape (L,)
    prior_variance: FloatArray  # shape (L,)
    scatter: FloatArray  # variance of a pressure beyond GAUGE, estimated from rides, shape (L,)
    past: FloatArray  # the load's logarithm before it was reopened, where it was known then, shape (L,)
    past_variance: FloatArray  # shape (L,)
    past_at: IntArray  # ns, start of the last window that determined it, shape (L,); 0: never
    disputed: IntArray  # ns, start of the first window of those that contradict the believed loads; 0: none, shape (1,)

    def shifted(self, by: int) -> Cargo:
        """With the time since when loads are disputed later by `by`, ns."""
        return replace(self, disputed=np.where(self.disputed != 0, self.disputed + by, 0))


def start(prior_variance: FloatArray) -> Cargo:
    """Nothing seen yet; variances (L,) of the loads' logarithms before any window."""
    zero = np.zeros(len(prior_variance))
    never = np.zeros(len(zero), dtype=np.int64)
    undisputed = np.zeros(1, dtype=np.int64)
    return Cargo(zero, zero + UNKNOWN, zero + np.nan, zero, prior_variance, zero, zero, zero, never, undisputed)


def remembered(cargo: Cargo, load: FloatArray, variance: FloatArray, known: BoolArray, at: int) -> Cargo:
    """With the loads (L,) that are `known` before they are reopened; at: ns, the last window that determined them."""
    return replace(
        cargo,
        past=np.where(known, load, cargo.past),
        past_variance=np.where(known, variance, cargo.past_variance),
        past_at=np.where(known, at, cargo.past_at),
    )


def disputed(cargo: Cargo, at: int, *, contradicting: bool) -> Cargo:
    """After a window that starts at `at`, ns, and is `contradicting` the believed loads, or not."""
    since = int(cargo.disputed[0])
    begins = (since or at) if contradicting else 0
    return cargo if begins == since else replace(cargo, disputed=np.array([begins], dtype=np.int64))


def after_ride(cargo: Cargo, load: FloatArray, variance: FloatArray) -> Cargo:
    """Constants learned from a ride at whose end the loads (L,) are known with `variance`."""
    seen, information = _of_windows(cargo, load, variance)
    fit = np.isfinite(cargo.pressure) & (information > 1 / KNOWN**2)
    information = np.where(fit, information, 1.0)
    noise = 1 / information + GAUGE**2
    gain = np.where(fit, cargo.variance / (cargo.variance + noise + cargo.scatter), 0.0)
    off = np.where(fit, cargo.pressure, 0.0) - seen - cargo.constant
    beyond = np.maximum(off**2 - GAUGE_LIMIT**2 * (cargo.variance + noise), 0.0)
    return replace(
        cargo,
        constant=cargo.constant + gain * off,
        variance=(1 - gain) * cargo.variance,
        scatter=cargo.scatter + np.where(fit, SCATTER_MEMORY, 0.0) * (beyond - cargo.scatter),
    )


def contradicted(cargo: Cargo, load: FloatArray, variance: FloatArray, open_: FloatArray) -> bool:
    """Whether windows contradict the pressure at departure; loads (L,) are known with `variance` now.

    open_: variances (L,) of loads without a pressure.
    """
    seen, information = _of_windows(cargo, load, variance)
    measured = (cargo.prior_variance < 0.5 * open_) & (information > 0)
    spread = cargo.prior_variance + 1 / np.where(measured, information, 1.0)
    return bool(np.any(measured & ((seen - cargo.prior) ** 2 > CONTRADICTION**2 * spread)))


def _of_windows(cargo: Cargo, load: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Loads (L,) that windows alone determine since departure, and their information (inverse variance)."""
    precision = 1 / np.maximum(variance, 1e-12)
    information = precision - 1 / cargo.prior_variance
    seen = (load * precision - cargo.prior / cargo.prior_variance) / np.where(information > 0, information, 1.0)
    return seen, information


def before_ride(cargo: Cargo, pressure: FloatArray, prior: FloatArray) -> Cargo:
    """Prior of the loads at departure: pressures (L,), Pa or NaN, combined with variances `prior` (L,)."""
    logarithm = _log(pressure)
    variance = cargo.variance + GAUGE**2 + cargo.scatter
    measured = np.where(np.isfinite(logarithm), logarithm - cargo.constant, 0.0)
    weight = np.where(np.isfinite(logarithm), 1 / variance, 0.0)
    total = weight + 1 / prior
    return replace(cargo, pressure=logarithm, prior=weight * measured / total, prior_variance=1 / total)


def during_ride(cargo: Cargo, pressure: FloatArray) -> Cargo:
    """Mean pressure of the current ride, updated by pressures (L,), Pa or NaN."""
    if np.isnan(pressure).all():
        return cargo
    logarithm = _log(pressure)
    mean = np.where(np.isfinite(cargo.pressure), cargo.pressure + MEMORY * (logarithm - cargo.pressure), logarithm)
    return replace(cargo, pressure=np.where(np.isfinite(mean), mean, cargo.pressure))


def _log(pressure: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(pressure > 0, np.log(np.where(pressure > 0, pressure, 1.0)), np.nan)
