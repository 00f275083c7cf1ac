"""Faults of measurements: gain, lag, filters, bias, noise, stuck; and an axle placed at the wrong time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.laws.base import RARE, ParameterSpec, grid
from sprung.model.laws.channel import SensorResponse, high_pass_section, resonance_section
from sprung.model.laws.kinds import SensorLaw
from sprung.model.signals import FloatArray

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
_CORNERS = 4  # trials per octave, of high-pass filters
_RATIOS = (0.03, 0.1)  # damping ratios of trial resonances
_SLOWEST = 3.0  # Hz, of an instrument on its mounting; chosen: cable ducts and sheet metal
_BEYOND = 4.0  # times the highest frequency that shows, up to which a resonance does


def _corners(lowest: float, highest: float) -> FloatArray:
    """Corners from what a record's length shows to a tenth of the band, where nothing of an instrument is left."""
    highest = max(lowest, 0.1 * highest)
    return grid(np.geomspace(lowest, highest, 1 + int(np.ceil(_CORNERS * np.log2(highest / lowest)))))


def _resonances(lowest: float, highest: float) -> FloatArray:
    """Resonances as close as they are wide within the band; wider apart above, where only their skirt shows."""
    least = max(lowest, _SLOWEST)
    if least >= highest:
        return np.zeros((0, 2))
    within = [
        grid(np.geomspace(least, highest, 2 + int(np.log(highest / least) / (2 * ratio))), [ratio]) for ratio in _RATIOS
    ]
    beyond = grid(np.geomspace(highest, _BEYOND * highest, 10)[1:], _RATIOS[:1])
    return np.concatenate([*within, beyond])


_HIGH_PASS = SensorLaw(
    name="high_pass",
    title="high-pass filter",
    parameters=(
        ParameterSpec("corner", "Hz", 1e-4, 1e3, "frequency below which little passes (-3 dB)", lambda seen: 0.1),
    ),
    absent=(0.0,),
    looks_like="slow motion is missing in a channel, or in all of a kind, and what is left of it comes early",
    confused_with=("sensor_lag", "suspended_mass", "air_spring", "mass_change"),
    sentence="shows little below {corner}, as behind a high-pass filter of first order",
    response=lambda p: SensorResponse(sections=high_pass_section(p[0])),
    at=("sensor",),
    trials=_corners,
    shared=True,
    kinds=("acceleration", "velocity"),
)
_SECOND_ORDER = replace(
    _HIGH_PASS,
    parameters=(
        *_HIGH_PASS.parameters,
        ParameterSpec("damping_ratio", "1", 0.1, 2.0, "of its two poles; above 1: two corners", lambda seen: 0.7),
    ),
    absent=(0.0, float(np.sqrt(0.5))),
    sentence="shows little below {corner}, as behind a high-pass filter of second order with a damping ratio of "
    "{damping_ratio}",
    response=lambda p: SensorResponse(sections=high_pass_section(p[0], p[1])),
    trials=lambda lowest, highest: grid(_corners(lowest, highest)[:, 0], [np.sqrt(0.5)]),
    prior_cost=RARE,
)
HIGH_PASS = replace(_HIGH_PASS, forms={"second order": _SECOND_ORDER})
_RESONANT = SensorLaw(
    name="mounting_resonance",
    title="resonance of the instrument on its mounting",
    parameters=(
        ParameterSpec("frequency", "Hz", 1.0, 1e5, "natural frequency", lambda seen: 30.0),
        ParameterSpec("damping_ratio", "1", 1e-3, 0.7, "of critical damping", lambda seen: 0.03),
    ),
    absent=(float("inf"), 0.0),
    looks_like="one channel is amplified around a frequency, or ever more towards the end of the band, and no other",
    confused_with=("suspended_mass", "flexible_mode", "sensor_gain", "sensor_lag"),
    sentence="resonates on its mounting at {frequency} with {damping_ratio} of critical damping",
    response=lambda p: SensorResponse(sections=resonance_section(p[0], p[1])),
    at=("sensor",),
    trials=_resonances,
    shared=True,
    kinds=("acceleration", "velocity"),
)
_ON_BRACKET = replace(
    _RESONANT,
    sentence="resonates on its bracket at {frequency} with {damping_ratio} of critical damping",
    response=lambda p: SensorResponse(sections=resonance_section(p[0], p[1], of_base=True)),
)
MOUNTING_RESONANCE = replace(_RESONANT, forms={"bracket": _ON_BRACKET})
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
SENSOR_ERROR = SensorLaw(
    name="sensor_error",
    title="error of one sensor",
    parameters=(),
    absent=(),
    looks_like="one channel shows what the others on the body contradict, and no law of a channel explains it",
    confused_with=("unknown",),
    sentence="the sensor shows something else than the motion of its body",
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
