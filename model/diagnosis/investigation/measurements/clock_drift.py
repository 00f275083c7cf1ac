"""A node whose clock runs at another rate: all its channels become later and later against the others.

What a model predicts of a group of sensors, delayed by t0 + r t, differs from what they show by

    e = -(t0 + r t) dy/dt,

so that r is the slope of the delays of segments, each a least-squares one.  A law that changes with time makes sensors
late as well, but not all of a node by the same time at all frequencies: it then explains more of the residual than r.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import resample

from sprung.model.diagnosis.fit.baseline import settled
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.investigation.configuration.hypotheses import Wiring
from sprung.model.diagnosis.investigation.measurements.floor import is_unexplained, with_noise_anew
from sprung.model.diagnosis.investigation.state import ClockDrift, Investigation
from sprung.model.diagnosis.record.signals import Signals, drifting, transform
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.signals import FloatArray

_FINER = 8  # times, before samples are interpolated


@dataclass(frozen=True)
class _Lateness:
    """Delay of a group of sensors over the time of the fitted part."""

    sensors: tuple[int, ...]
    middle: float  # s, about the middle of the fitted part
    rate: float  # s/s
    std: float  # of the rate, by the scatter of segments
    fall: float  # of chi-square that the rate promises


def without_clock_drift(state: Investigation) -> Investigation | None:
    """The investigation with a drifting clock put right; None if no clock drifts, or something else explains more."""
    rules = state.options.rules.acceptance
    if state.calibrations is not None or not is_unexplained(state):
        return None
    wired = Wiring(state.system, state.signals)
    groups = [group.sensors for group in wired.groups() if len(group.sensors) > 1 and not group.supports]
    late = max((_lateness(state, group) for group in groups), key=lambda one: one.fall, default=None)
    rival = max((one.score for one in state.last.candidates), default=0.0)
    if late is None or abs(late.rate) < rules.steady * late.std or late.fall < max(rival, rules.isolated):
        return None
    right, rate = state, 0.0
    for _ in range(rules.clock_rounds):
        right, rate = _retimed(right, late), rate + late.rate
        late = _lateness(right, late.sensors)
        if abs(late.rate) < late.std:
            break
    if state.fit.chi_square - right.fit.chi_square < rival:
        return None
    right = with_noise_anew(right)
    name = "|".join(state.signals.sensor_names[i] for i in late.sensors)
    return replace(
        right,
        last=screen(right.problem, right.fit, state.system.catalogue, state.options.project),
        clock_drifts=(*state.clock_drifts, ClockDrift(name, rate, late.std)),
    )


def _lateness(state: Investigation, sensors: tuple[int, ...]) -> _Lateness:
    """Delay of a group of sensors, by the residual of the present fit."""
    part, fit, at = state.problem.part, state.fit, list(sensors)
    grid, count = part.grid, state.options.rules.setup.segments
    inside = np.zeros((len(grid.omega), 1))
    inside[grid.band] = 1.0
    error = grid.inverse((fit.spectrum * inside)[:, at])
    change = grid.inverse((1j * grid.omega[:, None] * (part.sensors - fit.spectrum) * inside)[:, at])
    weight = 1 / fit.noise.sensors[at] ** 2
    pieces = np.array_split(np.arange(grid.samples), count)
    product = np.array([-np.sum(error[piece] * change[piece] * weight) for piece in pieces])
    square = np.array([np.sum(change[piece] ** 2 * weight) for piece in pieces])
    time = np.array([piece.mean() for piece in pieces]) * grid.step
    delay, share = product / square, square / np.sum(square)
    off = time - share @ time
    rate = float(share @ (off * delay) / (share @ off**2))
    scatter = delay - share @ delay - rate * off
    std = float(np.sqrt(share @ scatter**2 / (count - 2) / (share @ off**2)))
    middle = float(share @ delay + rate * (grid.samples * grid.step / 2 - share @ time))
    return _Lateness(sensors, middle, rate, std, rate**2 * float(square @ off**2))


def _retimed(state: Investigation, late: _Lateness) -> Investigation:
    """An investigation with a group of sensors put right, fitted again with the noise it has."""
    signals = retimed(state.signals, late.sensors, late.middle, late.rate, state.held.split)
    differentiated = drifting(state.system, signals.sensor_index)
    first = signals.part(0, state.held.split)
    part = transform(first, state.problem.noise, state.options.rules.record, differentiated=differentiated)
    problem = replace(state.problem, part=part)
    start = replace(state.fit.point, warm_start=())
    fit = settled(problem, optimise(problem, start, whitener=state.fit.whitener))
    base = fit
    if state.found:
        base = settled(problem, optimise(problem, replace(state.base.point, warm_start=())))
    held = replace(state.held, signals=signals)
    return replace(state, signals=signals, problem=problem, fit=fit, base=base, held=held)


def retimed(signals: Signals, sensors: tuple[int, ...], middle: float, rate: float, fitted: int) -> Signals:
    """Signals with some sensors earlier by a delay that grows at a rate.

    middle: the delay in the middle of the first `fitted` samples, s.
    """
    step = 1 / signals.sample_rate
    time = np.arange(signals.samples) * step
    late = middle + rate * (time - fitted * step / 2)
    columns = signals.sensors.copy()
    columns[:, list(sensors)] = at_times(columns[:, list(sensors)], step, time + late)
    return replace(signals, sensors=columns)


def at_times(series: FloatArray, step: float, times: FloatArray) -> FloatArray:
    """Columns (T, m), sampled every `step` s from zero on, at other times (T,); beyond the ends, as at them."""
    samples = len(series)
    time = np.arange(samples) * step
    line = series[:1] + (series[-1:] - series[:1]) * (time / time[-1])[:, None]
    finer = resample(series - line, _FINER * samples, axis=0)
    fine_time = np.arange(_FINER * samples) * step / _FINER
    within = np.clip(times, 0, time[-1])
    slope = (series[-1] - series[0]) / time[-1]
    return np.asarray(CubicSpline(fine_time, finer)(within) + series[0] + within[:, None] * slope)
