"""Faults of measurements: gain, lag, bias, noise, stuck; and an axle placed at the wrong time."""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import ParameterSpec, SensorLaw, Values
from sprung.model.signals import FloatArray

_PAD = 64  # samples mirrored at both ends, so that a shift in the frequency domain does not wrap round


def delayed(signal: FloatArray, seconds: float, sample_rate: float) -> FloatArray:
    """The signal `seconds` later, band-limited interpolation along the last axis; negative: earlier.

    Both ends are continued by point reflection, so that values and slopes run on; the first and last few samples
    are as good as that continuation.
    """
    signal = np.asarray(signal, dtype=float)
    n = signal.shape[-1]
    pad = min(_PAD, n - 1)
    head = 2 * signal[..., :1] - signal[..., pad:0:-1]
    tail = 2 * signal[..., -1:] - signal[..., -2 : -pad - 2 : -1]
    padded = np.concatenate([head, signal, tail], axis=-1)
    size = padded.shape[-1]
    ramp = np.linspace(0, 1, size)  # takes out the step between the two ends
    trend = padded[..., :1] + (padded[..., -1:] - padded[..., :1]) * ramp
    slope = (padded[..., -1:] - padded[..., :1]) * (sample_rate / (size - 1))
    frequency = np.fft.rfftfreq(size, 1 / sample_rate)
    turned = np.fft.rfft(padded - trend, axis=-1) * np.exp(-2j * np.pi * frequency * seconds)
    shifted = np.fft.irfft(turned, size, axis=-1) + trend - slope * seconds
    return shifted[..., pad : pad + n]


def _gain(truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return truth * p[0]


def _ungain(shown: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return shown / p[0]


def _lag(truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return delayed(truth, float(p[0]), sample_rate)


def _unlag(shown: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return delayed(shown, -float(p[0]), sample_rate)


def _bias(truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return truth + p[0]


def _unbias(shown: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return shown - p[0]


def _same(truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return truth


def _stuck(truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
    return np.broadcast_to(truth[..., :1], np.shape(truth)).copy()


_SECONDS = ParameterSpec("time", "s", -1.0, 1.0, "delay of the signal; negative: early", lambda seen: 0.005)

SENSOR_GAIN = SensorLaw(
    name="sensor_gain",
    title="wrong gain",
    parameters=(ParameterSpec("gain", "1", -10.0, 10.0, "shown over true", lambda seen: 0.9),),
    distort=_gain,
    restore=_ungain,
    absent=(1.0,),
    looks_like="the residual of one channel is a copy of its signal; other sensors of the body contradict it",
    confused_with=("sensor_lag", "mass_change"),
    sentence="the sensor shows {gain} times the true value",
)
SENSOR_LAG = SensorLaw(
    name="sensor_lag",
    title="time lag",
    parameters=(_SECONDS,),
    distort=_lag,
    restore=_unlag,
    absent=(0.0,),
    looks_like="the residual of one channel is its signal's derivative; grows with frequency",
    confused_with=("sensor_gain", "series_stiffness", "axle_delay"),
    sentence="the sensor is late by {time}",
)
SENSOR_BIAS = SensorLaw(
    name="sensor_bias",
    title="offset",
    parameters=(ParameterSpec("offset", "unit of the channel", -1e12, 1e12, "shown minus true", lambda seen: 0.0),),
    distort=_bias,
    restore=_unbias,
    absent=(0.0,),
    looks_like="a constant in one channel",
    confused_with=("damper_asymmetry",),
    sentence="the sensor is off by {offset}",
)
SENSOR_NOISE = SensorLaw(
    name="sensor_noise",
    title="excess noise",
    parameters=(ParameterSpec("ratio", "1", 0.0, 1e6, "noise over the noise declared", lambda seen: 2.0),),
    distort=_same,  # noise has no mean effect: the law is judged by the residual's spectrum
    restore=_same,
    absent=(1.0,),
    looks_like="white excess in one channel, without relation to any other",
    confused_with=("unknown",),
    sentence="the sensor has {ratio} times the noise declared",
)
SENSOR_STUCK = SensorLaw(
    name="sensor_stuck",
    title="stuck",
    parameters=(),
    distort=_stuck,
    restore=None,
    absent=(),
    looks_like="the channel repeats one value",
    confused_with=("sensor_gain",),
    sentence="the sensor repeats one value",
)
AXLE_DELAY = SensorLaw(
    name="axle_delay",
    title="axle placed at the wrong time",
    parameters=(_SECONDS,),
    distort=_lag,
    restore=_unlag,
    absent=(0.0,),
    looks_like="both wheels of one axle are late together: wrong speed or axle distance in the measuring chain",
    confused_with=("sensor_lag",),
    sentence="the inputs of this axle are late by {time}",
    where="axle",
)
