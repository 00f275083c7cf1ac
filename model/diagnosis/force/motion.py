"""Deflection and rate of an element from a measured displacement, with their noise levels.

Without a measured velocity the displacement is differentiated, which turns white noise of variance N per bin into
w^2 N.  A Wiener filter H = 1 - N / P on a smoothed periodogram P limits it; the noise that passes is the
errors-in-variables part of the force's noise floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.ndimage import median_filter, uniform_filter1d

from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.rules import RULES, ComponentRules, Rules
from sprung.model.signals import FloatArray

ComplexArray = NDArray[np.complexfloating]

_FINER, _MOST = 4, 100_000  # steps per sample for laws with memory, and their number at most


@dataclass(frozen=True)
class ElementMotion:
    """Motion of one element, evenly sampled."""

    time: FloatArray  # s since the start of the recording, (T,)
    deflection: FloatArray  # m, (T,)
    rate: FloatArray  # m/s, (T,)
    deflection_noise: float  # m, remaining noise
    rate_noise: float  # m/s
    dense: ElementMotion | None = None  # the same motion with values between the samples
    stride: int = 1  # dense samples per sample
    acceleration: FloatArray | None = None  # m/s^2, (T,)

    @classmethod
    def of(
        cls, time: FloatArray, deflection: FloatArray, rate: FloatArray, deflection_noise: float, rate_noise: float
    ) -> ElementMotion:
        """A motion with interpolated values, since laws with memory depend on reversals between samples."""
        finer = int(np.clip(_MOST // len(time), 1, _FINER))
        acceleration = _differentiated(rate, float(time[1] - time[0]))
        motion = cls(time, deflection, rate, deflection_noise, rate_noise, acceleration=acceleration)
        if finer == 1:
            return motion
        between = np.linspace(time[0], time[-1], (len(time) - 1) * finer + 1)
        cubic = CubicHermiteSpline(time, deflection, rate)
        dense = cls(between, cubic(between), cubic(between, 1), deflection_noise, rate_noise)
        return replace(motion, dense=dense, stride=finer)

    @property
    def followed(self) -> ElementMotion:
        """The dense motion for laws with memory; every `stride`-th sample is one of this motion."""
        return self if self.dense is None else self.dense

    @property
    def step(self) -> float:
        return float(self.time[1] - self.time[0])

    @property
    def middle(self) -> float:
        """The middle of the travel, m."""
        return 0.5 * float(self.deflection.max() + self.deflection.min())

    def repeats(self, rules: ComponentRules = RULES.component) -> bool:
        """Whether all cycles have the same travel and duration, as in a sine test."""
        at = turning_points(self.deflection, rules.turn * float(np.ptp(self.deflection)))
        if len(at) < rules.cycles:
            return False
        travels, durations = np.abs(np.diff(self.deflection[at])), self.time[at[2:]] - self.time[at[:-2]]
        tail = 0.5 * (1 - rules.cycles_alike)
        low, middle, high = np.quantile(np.column_stack([travels[1:], durations]), [tail, 0.5, 1 - tail], axis=0)
        return bool(np.all(high - low < rules.one_cycle * middle))

    def with_noise(self, deflection: float, rate: float) -> ElementMotion:
        """With additional independent noise levels, m and m/s."""
        noise = float(np.hypot(self.deflection_noise, deflection)), float(np.hypot(self.rate_noise, rate))
        return replace(self, deflection_noise=noise[0], rate_noise=noise[1])

    def delayed(self, late: float) -> ElementMotion:
        """The motion delayed by `late`, s, interpolated by cubic splines; constant beyond the ends."""
        if late == 0.0:
            return self
        at = np.clip(self.time - late, self.time[0], self.time[-1])
        dense = None if self.dense is None else self.dense.delayed(late)
        earlier = self._between(at)
        acceleration = earlier[:, 2] if self.acceleration is not None else None
        return replace(self, deflection=earlier[:, 0], rate=earlier[:, 1], acceleration=acceleration, dense=dense)

    @cached_property
    def _between(self) -> CubicSpline:
        further = () if self.acceleration is None else (self.acceleration,)
        return CubicSpline(self.time, np.column_stack([self.deflection, self.rate, *further]))

    def noisier(self, seed: int = 0) -> ElementMotion:
        """The motion with added noise of its own level and band."""
        if self.deflection_noise <= 0 or self.rate_noise <= 0:
            return self
        fastest = (
            np.sqrt(3.0) * self.rate_noise / self.deflection_noise
        )  # rad/s, edge of a white spectrum with these deviations
        count = len(self.time)
        omega = 2 * np.pi * np.fft.rfftfreq(count, self.step)
        low = np.fft.rfft(np.random.default_rng(seed).standard_normal(count)) * ((omega > 0) & (omega <= fastest))
        if not np.any(low):
            return self
        noise = np.fft.irfft(low, count)
        size = self.deflection_noise / max(float(np.std(noise)), 1e-300)
        rate = np.fft.irfft(1j * omega * low, count)
        return ElementMotion.of(
            self.time,
            self.deflection + size * noise,
            self.rate + size * rate,
            self.deflection_noise,
            self.rate_noise,
        )

    def undersampled(self) -> ElementMotion:
        """The motion interpolated from these samples only."""
        return ElementMotion.of(self.time, self.deflection, self.rate, self.deflection_noise, self.rate_noise)

    def every(self, stride: int) -> ElementMotion:
        """Every `stride`-th sample; laws with memory use steps of half of that."""
        if stride == 1:
            return self
        between = stride * self.stride
        skip = between // 2 if between % 2 == 0 else 1
        return replace(self._thinned(stride), dense=self.followed._thinned(skip), stride=between // skip)

    def _thinned(self, stride: int) -> ElementMotion:
        return replace(
            self,
            time=self.time[::stride],
            deflection=self.deflection[::stride],
            rate=self.rate[::stride],
            dense=None,
            stride=1,
            acceleration=None if self.acceleration is None else self.acceleration[::stride],
        )


def turning_points(series: FloatArray, least: float) -> NDArray[np.intp]:
    """Samples at which a series (T,) turns by more than `least`."""
    extremes = np.flatnonzero(np.diff(np.sign(np.diff(series))) != 0) + 1
    found: list[int] = []
    way = 0
    for at in extremes.tolist():
        moved = series[at] - series[found[-1]] if found else 0.0
        if not found:
            found.append(at)
        elif moved * way > 0 or (way == 0 and abs(moved) > least):
            way = 1 if moved > 0 else -1
            if len(found) > 1:
                found[-1] = at  # continues in the same direction
            else:
                found.append(at)
        elif way and -moved * way > least:
            found.append(at)
            way = -way
    return np.array(found, dtype=np.intp)


def without_gaps(series: FloatArray) -> FloatArray:
    """A series (T,) with its gaps closed by linear interpolation."""
    good = np.isfinite(series)
    if good.all():
        return series
    at = np.arange(len(series))
    return np.interp(at, at[good], series[good])


def still_stretches(series: FloatArray, sample_rate: float, all_rules: Rules = RULES) -> list[slice]:
    """Where a motion (T,) stands still."""
    rules = all_rules.component
    span = max(rules.still_samples, int(rules.rest * sample_rate))
    if len(series) < 4 * span:
        return []
    mean = uniform_filter1d(series, span)
    deviation = np.sqrt(np.maximum(uniform_filter1d(series**2, span) - mean**2, 0.0))
    noise = white_noise(series, all_rules.white_noise)
    rests = deviation < max(rules.rests * float(np.std(series)), rules.moves * noise)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rests.astype(int), [0]])))
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [slice(int(a), int(b)) for a, b in pairs if b - a >= span]


def noise_at_rest(series: FloatArray, stretches: list[slice]) -> float | None:
    """Standard deviation of a series (T,) about a line in the quietest standstill; None without any.

    What rings down, creeps or trembles after a test is no noise.
    """
    levels = []
    for stretch in stretches:
        values = series[stretch]
        if len(values) > 2:
            at = np.arange(len(values))
            rest = values - np.polyval(np.polyfit(at, values, 1), at)
            levels.append(float(np.sqrt(rest @ rest / (len(values) - 2))))
    return min(levels, default=None)


def element_motion(
    displacement: FloatArray,
    velocity: FloatArray | None,
    sample_rate: float,
    start: float = 0.0,
    rules: Rules = RULES,
) -> ElementMotion:
    """Motion from a measured displacement (T,) and, where there is one, a measured velocity (T,)."""
    count, step = len(displacement), 1 / sample_rate
    time = start + step * np.arange(count, dtype=np.float64)
    spectrum, omega, line = _continued(displacement, sample_rate)
    noise = white_noise(displacement, rules.white_noise)
    passed = _wiener(spectrum, noise, rules.component.stands_out)
    rate_spectrum = 1j * omega * passed * spectrum
    rate_power = omega**2 * passed**2 * noise**2
    if velocity is not None:
        level = white_noise(velocity, rules.white_noise)
        seen, _, _ = _continued(velocity, sample_rate, odd=False)
        seen[0] -= (3 * count - 2) * line
        variance_d = (omega * noise) ** 2  # of the differentiated displacement
        share = variance_d / np.maximum(variance_d + max(level, 1e-300) ** 2, 1e-300)  # of the measured velocity
        rate_spectrum = share * seen + (1 - share) * 1j * omega * spectrum
        rate_spectrum = _wiener(rate_spectrum, level, rules.component.stands_out) * rate_spectrum
        rate_power = share * level**2
    here = slice(count - 1, 2 * count - 1)
    rate = np.asarray(np.fft.irfft(rate_spectrum, 3 * count - 2)[here] + line, dtype=np.float64)
    periodic = np.asarray(np.fft.irfft(passed * spectrum, 3 * count - 2)[here], dtype=np.float64)
    smooth = np.add(periodic, _line(displacement, sample_rate, count, line), dtype=np.float64)
    left = float(np.sqrt(np.mean(passed**2)) * noise)
    return ElementMotion.of(time, smooth, rate, left, float(np.sqrt(np.mean(rate_power))))


def _differentiated(rate: FloatArray, step: float) -> FloatArray:
    """Rate of change of a rate (T,), at all frequencies of the record alike."""
    count = len(rate)
    spectrum, omega, line = _continued(rate, 1 / step)
    return np.asarray(np.fft.irfft(1j * omega * spectrum, 3 * count - 2)[count - 1 : 2 * count - 1] + line)


def _line(series: FloatArray, sample_rate: float, count: int, slope: float) -> FloatArray:
    return np.asarray(series[0] + slope * np.arange(count) / sample_rate, dtype=np.float64)


def _continued(series: FloatArray, sample_rate: float, odd: bool = True) -> tuple[ComplexArray, FloatArray, float]:
    """Spectrum of a series extended at both ends to three times its length; w, rad/s; and the slope removed.

    Positions are extended as odd functions about their ends, which preserves the slope; rates as even ones.
    """
    count = len(series)
    slope = float(series[-1] - series[0]) / ((count - 1) / sample_rate) if odd else 0.0
    rest = series - _line(series, sample_rate, count, slope) if odd else series
    sign = -1.0 if odd else 1.0
    # the line joins the two ends, so that both are zero and the odd continuation passes through them
    whole = np.concatenate([sign * rest[:0:-1], rest, sign * rest[-2::-1]])
    omega = np.asarray(2 * np.pi * np.fft.rfftfreq(len(whole), 1 / sample_rate), dtype=np.float64)
    return np.fft.rfft(whole), omega, slope


def _wiener(spectrum: ComplexArray, noise: float, stands_out: float) -> FloatArray:
    """Wiener filter up to the highest frequency at which the power exceeds the noise by a ratio."""
    count = 2 * (len(spectrum) - 1)
    power = np.abs(spectrum) ** 2 / max(count, 1)
    reach = max(5, count // 400) | 1
    smooth = uniform_filter1d(median_filter(power, size=3), size=reach)
    level = max(noise**2, 1e-300)
    passed = np.clip(1 - level / np.maximum(smooth, 1e-300), 0.0, 1.0)
    out = np.flatnonzero(smooth > stands_out * level)
    passed[(out[-1] + 1 if len(out) else 1) :] = 0.0
    found: FloatArray = passed
    return found
