"""Decimation of recordings that are sampled much faster than their motion requires.

Time and memory of a diagnosis grow with the number of samples, but higher sample rates are only informative if the
sensors show more than noise at the added frequencies.  Otherwise recordings are decimated behind a linear-phase filter,
the same for all signals, which preserves their linear relation.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.rules import RecordRules
from sprung.model.mechanics import DISPLACEMENT
from sprung.model.signal_filters import low_pass, upfirdn
from sprung.model.signals import FloatArray
from sprung.model.system import System

_PASS, _STOP = 0.4, 0.55  # of the new rate, edges of pass band and stop band
_DAMPED = 80.0  # dB
_MOST = 20  # of the old rate over the new one


def slower_by(system: System, values: FloatArray, sample_rate: float, rules: RecordRules) -> int:
    """Integer factor by which a recording's rate can be reduced; 1: not at all.

    values (T, C): gap-free columns in the order of `system.channels`; sensors that are absent are NaN.
    """
    samples, kinds = len(values), system.mechanics.sensor_kind
    sensors = values[:, len(system.inputs) :]
    noise = np.array([sensor.noise for sensor in system.file.sensors.values()])
    fastest = max((mode.frequency for mode in system.mechanics.modes(system.bodies)), default=0.0)
    frequency = np.fft.rfftfreq(samples, 1 / sample_rate)
    taper = np.hanning(samples)[:, None]
    present = np.isfinite(sensors).all(axis=0)
    level = sensors[:, present] - np.linspace(sensors[0, present], sensors[-1, present], samples)
    power = np.abs(np.fft.rfft(level * taper, axis=0)) ** 2
    of_noise = np.sum(taper**2) * noise[present] ** 2 * np.ones_like(power)
    rates = np.where(kinds[present] == DISPLACEMENT, frequency[:, None] ** 2, 1.0)  # a position by its rate
    power, of_noise = power * rates, of_noise * rates

    def loses_nothing(factor: int) -> bool:
        compared = rules.compared * sample_rate / factor
        if fastest * rules.modes_within > compared:
            return False
        above = frequency > compared
        most = rules.faster * power.sum(axis=0) + rules.by_noise * of_noise[above].sum(axis=0)
        return bool(np.all(power[above].sum(axis=0) <= most))

    factor = 1
    while samples > rules.enough * factor and factor < _MOST and loses_nothing(factor + 1):
        factor += 1
    return factor


def slower(values: FloatArray, factor: int) -> tuple[FloatArray, int]:
    """Decimated columns (T', C) of columns (T, C), and the index of the old sample that is the first.

    Transients of the filter at both ends are cut off; columns of NaN are kept.
    """
    low = low_pass(_PASS, _STOP, _DAMPED, factor)
    half = len(low) // 2
    first = -(-half // factor) * factor
    filtered = upfirdn(low, values)[half : half + len(values)]
    return filtered[first : len(values) - half : factor], first
