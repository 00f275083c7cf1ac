"""Estimates from elsewhere whose numbers cannot be: one such would be in its vehicle's tracker for good."""

from __future__ import annotations

from typing import get_args

import numpy as np

from sprung.model.signals import Deviating, Estimate, FaultKind, FloatArray, MeasurementFault
from sprung.model.system import System
from sprung.service.fleet.message import WindowEstimate

MOST_LOG_RATIO = 25.0  # a factor of 7e10 either way: between foam rubber and bedrock
LARGEST = 1e12  # of what is measured, in SI units, as in windows that are sent to be identified
ROUNDING = 1e-6  # of a correlation: matrices are sent with rounded numbers
KINDS = get_args(FaultKind)


def impossible(window: WindowEstimate, system: System) -> str | None:
    """What cannot be in a window's estimate, of the right shape, or in what is said beside it; None where all can."""
    if not 0 <= window.repaired_samples <= system.window * len(system.channels):
        return f"{window.repaired_samples} repaired samples"
    if window.auxiliary is not None and bool((np.abs(window.auxiliary) > LARGEST).any()):  # NaN: it was not measured
        return "a measurement beside it"
    e = window.estimate
    return None if e is None else _of_estimate(e) or _of_deviations(e.deviating) or _of_faults(e.faults, system)


def _of_estimate(e: Estimate) -> str | None:
    if not bool((np.abs(e.log_ratio) <= MOST_LOG_RATIO).all()):
        return "a ratio to the nominal value"
    variance = e.covariance.diagonal()
    if not bool(((variance > 0) & (variance <= MOST_LOG_RATIO**2)).all()) or not _is_covariance(e.covariance):
        return "a covariance that is none"
    if not 0 <= e.chi_square < np.inf or not 0 <= e.noise < np.inf:
        return "residual power or noise"
    if e.nrmse < 0 or bool((e.per_sensor < 0).any()):  # NaN: of a sensor that is absent, or shows nothing
        return "a negative error"
    return None


def _of_deviations(d: Deviating | None) -> str | None:
    if d is None:
        return None
    numbers = (d.point, d.given, d.cross, d.information, d.score)
    if not all(bool(np.isfinite(one).all()) for one in numbers) or not 0 <= d.freedom < np.inf:
        return "numbers of its deviations that are not finite"
    return None if _is_covariance(d.given) and _is_covariance(d.information) else "a covariance that is none"


def _of_faults(faults: tuple[MeasurementFault, ...], system: System) -> str | None:
    known = {channel.name for channel in (*system.channels, *system.auxiliary)}
    for fault in faults:
        if fault.kind not in KINDS or not known.issuperset(fault.channel.split("|")):
            return "a fault of no measurement"
        if not abs(fault.value) <= LARGEST or not 0 <= fault.std <= LARGEST:
            return "a fault whose size is none"
    return None


def _is_covariance(matrix: FloatArray) -> bool:
    """Whether it is symmetric and positive semi-definite, but for rounding, where it is not 0."""
    variance = matrix.diagonal()
    if not (bool(np.isfinite(matrix).all()) and bool((variance >= 0).all())):
        return False
    held = variance > 0
    if bool(matrix[~held].any()):
        return False
    scale = np.sqrt(variance[held])
    correlation = matrix[np.ix_(held, held)] / np.outer(scale, scale)
    if not np.allclose(correlation, correlation.T, rtol=0, atol=ROUNDING):
        return False
    return bool((np.linalg.eigvalsh(correlation) >= -ROUNDING * max(1, len(correlation))).all())
