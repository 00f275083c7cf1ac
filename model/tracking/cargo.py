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
BELIED = 4.0  # standard deviations of what windows say against a pressure from which on it is not believed
CAUGHT = 3.0  # standard deviations of one ride that a gauge as good as stated errs by at most
SOON = 0.3  # weight of the newest ride in how wrong a gauge has been


@dataclass(frozen=True, slots=True, eq=False)
class Cargo:
    """The constants of the pressures, and this ride so far."""

    constant: FloatArray  # a, shape (L,)
    variance: FloatArray  # of it, shape (L,)
    pressure: FloatArray  # logarithm of the mean pressure of this ride, NaN: none, shape (L,)
    prior: FloatArray  # of the load's logarithm at departure, shape (L,)
    prior_variance: FloatArray  # shape (L,)
    scatter: FloatArray  # variance of a pressure beyond that of a good gauge, as rides have shown it, shape (L,)


def start(prior_variance: FloatArray) -> Cargo:
    """Nothing seen yet; variances (L,) of the loads' logarithms before any window."""
    zero = np.zeros(len(prior_variance))
    return Cargo(zero, zero + UNKNOWN, zero + np.nan, zero, prior_variance, zero)


def arrived(cargo: Cargo, load: FloatArray, variance: FloatArray) -> Cargo:
    """At the end of a ride after which the loads (L,) were believed with `variance`: constants learn from it."""
    seen, told = _of_windows(cargo, load, variance)
    fit = np.isfinite(cargo.pressure) & (told > 1 / 0.03**2)
    told = np.where(fit, told, 1.0)
    noise = 1 / told + GAUGE**2
    gain = np.where(fit, cargo.variance / (cargo.variance + noise + cargo.scatter), 0.0)
    off = np.where(fit, cargo.pressure, 0.0) - seen - cargo.constant
    beyond = np.maximum(off**2 - CAUGHT**2 * (cargo.variance + noise), 0.0)
    return replace(
        cargo,
        constant=cargo.constant + gain * off,
        variance=(1 - gain) * cargo.variance,
        scatter=cargo.scatter + np.where(fit, SOON, 0.0) * (beyond - cargo.scatter),
    )


def contradicted(cargo: Cargo, load: FloatArray, variance: FloatArray, open_: FloatArray) -> bool:
    """Whether windows speak against what a pressure said at departure; loads (L,) are believed with `variance` now.

    open_: variances (L,) of loads of which no pressure speaks.
    """
    seen, told = _of_windows(cargo, load, variance)
    said = (cargo.prior_variance < 0.5 * open_) & (told > 0)
    spread = cargo.prior_variance + 1 / np.where(said, told, 1.0)
    return bool(np.any(said & ((seen - cargo.prior) ** 2 > BELIED**2 * spread)))


def _of_windows(cargo: Cargo, load: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What windows alone have said of the loads since departure, (L,), and their information."""
    precision = 1 / np.maximum(variance, 1e-12)
    told = precision - 1 / cargo.prior_variance
    seen = (load * precision - cargo.prior / cargo.prior_variance) / np.where(told > 0, told, 1.0)
    return seen, told


def departed(cargo: Cargo, pressure: FloatArray, prior: FloatArray) -> Cargo:
    """Before a ride: prior of the loads, variances `prior` (L,) where pressures (L,), Pa, do not say more."""
    logarithm = _log(pressure)
    variance = cargo.variance + GAUGE**2 + cargo.scatter
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
