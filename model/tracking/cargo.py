"""Loads: what air-spring pressure says of them, and when one is beyond what the system file allows.

The pressure of an air spring is in proportion to the weight on it, so log p = a + log(loaded mass / empty mass).  The
constant a is learned: every ride between two stops gives one value of it, from what the windows alone said of the
load.  From then on the pressure at the next departure is the load's prior, and with it the load is known at once.

L loads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import FloatArray

GAUGE = 0.015  # of a pressure: hysteresis of levelling valves and the gauge
UNKNOWN = 1e6  # variance of a constant that nothing is known of
MEMORY = 0.05  # weight of the newest window's pressure in the mean of a ride


@dataclass(frozen=True, slots=True, eq=False)
class Cargo:
    """The constants of the pressures, and this ride so far."""

    constant: FloatArray  # a, shape (L,)
    variance: FloatArray  # of it, shape (L,)
    pressure: FloatArray  # logarithm of the mean pressure of this ride, NaN: none, shape (L,)
    prior: FloatArray  # of the load's logarithm at departure, shape (L,)
    prior_variance: FloatArray  # shape (L,)


def start(prior_variance: FloatArray) -> Cargo:
    """Nothing seen yet; variances (L,) of the loads' logarithms before any window."""
    zero = np.zeros(len(prior_variance))
    return Cargo(zero, zero + UNKNOWN, zero + np.nan, zero, prior_variance)


def arrived(cargo: Cargo, load: FloatArray, variance: FloatArray) -> Cargo:
    """At the end of a ride after which the loads (L,) were believed with `variance`: constants learn from it."""
    told = 1 / np.maximum(variance, 1e-12) - 1 / cargo.prior_variance  # information of the windows alone
    fit = np.isfinite(cargo.pressure) & (told > 1 / 0.03**2)
    told = np.where(fit, told, 1.0)
    seen = (load / np.maximum(variance, 1e-12) - cargo.prior / cargo.prior_variance) / told
    noise = 1 / told + GAUGE**2
    gain = np.where(fit, cargo.variance / (cargo.variance + noise), 0.0)
    off = np.where(fit, cargo.pressure, 0.0) - seen - cargo.constant
    return replace(cargo, constant=cargo.constant + gain * off, variance=(1 - gain) * cargo.variance)


def departed(cargo: Cargo, pressure: FloatArray, prior: FloatArray) -> Cargo:
    """Before a ride: prior of the loads, variances `prior` (L,) where pressures (L,), Pa, do not say more."""
    logarithm = _log(pressure)
    variance = cargo.variance + GAUGE**2
    said = np.where(np.isfinite(logarithm), logarithm - cargo.constant, 0.0)
    weight = np.where(np.isfinite(logarithm), 1 / variance, 0.0)
    total = weight + 1 / prior
    return replace(cargo, pressure=logarithm, prior=weight * said / total, prior_variance=1 / total)


def felt(cargo: Cargo, pressure: FloatArray) -> Cargo:
    """During a ride: its mean pressure."""
    if np.isnan(pressure).all():
        return cargo
    logarithm = _log(pressure)
    moved = np.where(np.isfinite(cargo.pressure), cargo.pressure + MEMORY * (logarithm - cargo.pressure), logarithm)
    return replace(cargo, pressure=np.where(np.isfinite(moved), moved, cargo.pressure))


def _log(pressure: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(pressure > 0, np.log(np.where(pressure > 0, pressure, 1.0)), np.nan)
