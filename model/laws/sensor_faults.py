"""Faults of measurements: gain, lag, bias, noise, stuck; and an axle placed at the wrong time."""

from __future__ import annotations

from dataclasses import replace

from sprung.model.laws.base import RARE, ParameterSpec
from sprung.model.laws.channel import SensorResponse
from sprung.model.laws.kinds import SensorLaw

OF_CHANNEL = "unit of the channel"  # of a parameter
_SECONDS = ParameterSpec("time", "s", -1.0, 1.0, "delay of the signal; negative: early", lambda seen: 0.005)


def _tenth_of_a_sample(step: float, amplitude: float) -> float:
    return 0.1 * step


SENSOR_GAIN = SensorLaw(
    name="sensor_gain",
    title="wrong gain",
    parameters=(ParameterSpec("gain", "1", -10.0, 10.0, "shown over true", lambda seen: 0.9, plausible=(0.2, 5.0)),),
    absent=(1.0,),
    looks_like="the residual of one channel is a copy of its signal; other sensors of the body contradict it",
    confused_with=("sensor_lag", "mass_change"),
    sentence="the sensor shows {gain} times the true value",
    response=lambda p: SensorResponse(gain=p[0]),
    at=("sensor", "support", "force"),
    scale=lambda step, amplitude: 0.1,
    of_instrument=lambda sheet: sheet.gain,
)
_LATE = SensorLaw(
    name="sensor_lag",
    title="time lag",
    parameters=(_SECONDS,),
    absent=(0.0,),
    looks_like="the residual of one channel is its signal's derivative; grows with frequency",
    confused_with=("sensor_gain", "series_stiffness", "axle_delay"),
    sentence="the sensor is late by {time}",
    response=lambda p: SensorResponse(delay=p[0]),
    at=("sensor", "support"),
    scale=_tenth_of_a_sample,
    of_instrument=lambda sheet: min(sheet.delay, sheet.step),  # fast instruments have better clocks
)
# Filters in the measuring chain are late by another law; at the frequencies that a suspension passes on alike at first
_FIRST_ORDER = replace(
    _LATE,
    parameters=(replace(_SECONDS, meaning="time constant of a first-order lag"),),
    response=lambda p: SensorResponse(lag=p[0]),
    sentence="the sensor lags with a time constant of {time}",
)
_BOTH = replace(
    _FIRST_ORDER,
    parameters=(
        *_FIRST_ORDER.parameters,
        ParameterSpec("delay", "s", -1.0, 1.0, "transport delay besides the lag", lambda seen: 0.001),
    ),
    absent=(0.0, 0.0),
    response=lambda p: SensorResponse(lag=p[0], delay=p[1]),
    sentence="the sensor lags with a time constant of {time}, and by {delay} besides",
    of_instrument=None,
    prior_cost=RARE,
)
SENSOR_LAG = replace(_LATE, forms={"first order": _FIRST_ORDER, "first order and delay": _BOTH})
SENSOR_BIAS = SensorLaw(
    name="sensor_bias",
    title="offset",
    parameters=(ParameterSpec("offset", OF_CHANNEL, -1e12, 1e12, "shown minus true", lambda seen: 0.0),),
    absent=(0.0,),
    looks_like="a constant in one channel",
    confused_with=("damper_asymmetry",),
    sentence="the sensor is off by {offset}",
    response=lambda p: SensorResponse(offset=p[0]),
    at=("sensor", "support", "force"),
    of_instrument=lambda sheet: max(sheet.zero, sheet.gain * sheet.size),  # small signals: the zero, large: the gain
)
SENSOR_NOISE = SensorLaw(
    name="sensor_noise",
    title="excess noise",
    parameters=(ParameterSpec("ratio", "1", 0.0, 1e6, "noise over the noise declared", lambda seen: 2.0),),
    absent=(1.0,),
    looks_like="white excess in one channel, without relation to any other",
    confused_with=("unknown",),
    sentence="the sensor has {ratio} times the noise declared",
    scales_noise=True,
)
SENSOR_STUCK = SensorLaw(
    name="sensor_stuck",
    title="stuck",
    parameters=(),
    absent=(),
    looks_like="the channel repeats one value",
    confused_with=("sensor_gain",),
    sentence="the sensor repeats one value",
    stuck=True,
)
AXLE_DELAY = SensorLaw(
    name="axle_delay",
    title="axle placed at the wrong time",
    parameters=(_SECONDS,),
    absent=(0.0,),
    looks_like="both wheels of one axle are late together: wrong speed or axle distance in the measuring chain",
    confused_with=("sensor_lag",),
    sentence="the inputs of this axle are late by {time}",
    response=lambda p: SensorResponse(delay=p[0]),
    scale=_tenth_of_a_sample,
    where="axle",
)
