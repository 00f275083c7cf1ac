"""Statistics of a fleet: usual values, outliers, trends, and predicted crossings of limits.

Levels y are log-ratios to nominal with standard deviation s.  Pure functions of arrays; the store gives them
(`service.store.levels`).

- Usual: y = m + class + own + error, class ~ N(0, tc^2), own ~ N(0, tv^2), for all elements of one type ("secondary
  dampers") together; the variances by moments (DerSimonian and Laird 1986), the means shrunken towards the level above.
- Common mode: what all vehicles of a class do at the same time, the median of their departures from their own means.
  It is weather, a workshop's habit or a clock, and no vehicle's wear: trends are told without it.  Its line over the
  temperature, where that is measured, says how much of it is weather.
- Trend: weighted least squares of what is left, the residual scatter taken into account where it exceeds s.
- Limit: P(crossed by t) = Phi((b t - d) / sqrt(s^2 + sb^2 t^2)) for the distance d to the limit and the slope b (a
  straight line with uncertain start and slope); quantiles of t are given where they are within the horizon.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sprung.model.signals import BoolArray, FloatArray
from sprung.service.store.archive import fleet_of
from sprung.service.store.levels import FleetLevels

DAY_NS = 86_400e9
HORIZON_DAYS = 1000.0
QUANTILES = (0.05, 0.5, 0.95)
LEAST_POINTS = 3  # of a trend
LEAST_VEHICLES = 3  # of a class that has a common mode
LEAST_CHANGE = 1e-4  # log-ratio, of a common mode that is reported
LEAST_DAYS, LEAST_KELVIN = 6, 3.0  # of a line over temperature
ONE_SIDED_95 = 1.645


@dataclass(frozen=True, slots=True)
class UsualLevel:
    """What is usual for one type of element in one class of vehicles."""

    kind: str  # such as secondary.damping
    vehicle_class: str
    vehicles: int
    mean: float  # log-ratio
    mean_std: float
    own_std: float  # by which elements of one class differ (tv)
    class_std: float  # by which classes differ (tc)


@dataclass(frozen=True, slots=True)
class Standing:
    """One parameter of one vehicle."""

    vehicle: str
    parameter: str
    level: float  # newest log-ratio
    std: float
    usual: float  # of its type and class
    departure: float  # level - usual, in standard deviations of the class
    slope: float  # log-ratio a day, common mode taken out; NaN where there are too few points
    slope_std: float
    crossing_days: tuple[float | None, ...]  # until it is `limit` off its own mean: 5 %, 50 %, 95 %
    crossed: tuple[float, ...]  # probability by the days asked for


@dataclass(frozen=True, slots=True)
class CommonMode:
    """What the vehicles of a class did together."""

    vehicle_class: str
    kind: str
    time: int  # ns since epoch, begin of that part
    change: float  # log-ratio
    std: float
    temperature: float  # degC, mean over vehicles that measure it; NaN if none does

    @property
    def sure(self) -> bool:
        """Whether they did anything at all."""
        return abs(self.change) > 3 * self.std and abs(self.change) > LEAST_CHANGE


@dataclass(frozen=True, slots=True)
class TemperatureEffect:
    """Dependence of a class's common mode on the temperature."""

    vehicle_class: str
    kind: str
    per_kelvin: float  # log-ratio
    std: float
    explained: float  # share of the common mode's variance
    days: int


@dataclass(frozen=True, slots=True)
class FleetKnowledge:
    """All of it."""

    usual: tuple[UsualLevel, ...]
    standings: tuple[Standing, ...]
    common: tuple[CommonMode, ...]
    temperature: tuple[TemperatureEffect, ...] = ()


def kind_of(parameter: str) -> str:
    """The type of a parameter: its name without the numbers of elements (secondary_1l.damping)."""
    element, _, quantity = parameter.rpartition(".")
    return f"{re.sub(r'_?[0-9]+[a-z]?$', '', element) or element}.{quantity}"


def knowledge(
    found: FleetLevels, names: Sequence[str], known_std: float, limit: float, days: Sequence[float] = (30, 90, 365)
) -> FleetKnowledge:
    """All statistics of `found`.

    known_std: a level less sure than this is the prior and no measurement; limit: change of the log-ratio from the
    vehicle's own first level that counts as crossed; days: for which the probability of crossing is given.
    """
    if not found.vehicles:
        return FleetKnowledge((), (), ())
    level = np.where(found.std < known_std, found.level, np.nan)
    classes = np.array([fleet_of(name) for name in found.vehicles])
    kinds = np.array([kind_of(name) for name in names])
    rest, common = without_common_mode(found, level, classes, kinds)
    usual = []
    standings = []
    newest, newest_std = newest_of(level), newest_of(np.where(np.isnan(level), np.nan, found.std))
    slope, slope_std, first = trends(found.time, rest, found.std)
    for kind in dict.fromkeys(kinds.tolist()):
        columns = np.flatnonzero(kinds == kind).tolist()
        levels = usual_levels(kind, newest[:, columns], newest_std[:, columns], classes)
        usual += levels
        by_class = {one.vehicle_class: one for one in levels}
        for v, vehicle in enumerate(found.vehicles):
            for p in columns:
                if np.isnan(newest[v, p]):
                    continue
                one = by_class[classes[v]]
                spread = np.sqrt(one.own_std**2 + newest_std[v, p] ** 2 + one.mean_std**2)
                moved = newest[v, p] - first[v, p]
                line = (moved, newest_std[v, p], slope[v, p], slope_std[v, p], limit)
                standings.append(
                    Standing(
                        vehicle,
                        names[p],
                        float(newest[v, p]),
                        float(newest_std[v, p]),
                        one.mean,
                        float((newest[v, p] - one.mean) / spread),
                        float(slope[v, p]),
                        float(slope_std[v, p]),
                        crossing_days(*line),
                        tuple(float(probability(day, *line)) for day in days),
                    )
                )
    sure = tuple(one for one in common if one.sure)
    return FleetKnowledge(tuple(usual), tuple(standings), sure, temperature_effects(common))


def worst(standings: Sequence[Standing], count: int) -> list[Standing]:
    """The largest significant departures from the usual value."""
    return sorted(standings, key=lambda one: -abs(one.departure))[:count]


def fastest(standings: Sequence[Standing], count: int) -> list[Standing]:
    """Those that get worse fastest: by the slope that is exceeded with 95 %."""
    moving = [one for one in standings if np.isfinite(one.slope) and sure_slope(one) > 0]
    return sorted(moving, key=lambda one: -sure_slope(one))[:count]


def sure_slope(one: Standing) -> float:
    """Log-ratio a day, exceeded with 95 %; negative where not even the sign is sure."""
    return abs(one.slope) - ONE_SIDED_95 * one.slope_std


def newest_of(values: FloatArray) -> FloatArray:
    """The last of (V, N, P) that is no NaN, shape (V, P)."""
    V, N, P = values.shape
    out = np.full((V, P), np.nan)
    for n in range(N):
        out = np.where(np.isnan(values[:, n]), out, values[:, n])
    return out


def usual_levels(kind: str, level: FloatArray, std: FloatArray, classes: np.ndarray) -> list[UsualLevel]:
    """Class means, shrunken towards the mean of all classes; level and std of shape (V, elements of the type)."""
    known = []
    for name in dict.fromkeys(classes.tolist()):
        own = classes == name
        ok = np.isfinite(level[own])
        known.append((name, level[own][ok], std[own][ok], int(ok.any(axis=1).sum())))
    known = [one for one in known if len(one[1])]
    within = [_moments(y, s) for _, y, s, _ in known]
    degrees = np.array([len(y) - 1 for _, y, _, _ in known])
    own_variance = float(np.sum(degrees * [one[2] for one in within]) / max(degrees.sum(), 1))
    means = np.array([np.average(y, weights=1 / (s**2 + own_variance)) for _, y, s, _ in known])
    errors = np.array([np.sqrt(1 / np.sum(1 / (s**2 + own_variance))) for _, _, s, _ in known])
    overall, _, between = _moments(means, errors)
    share = between / (between + errors**2) if between > 0 else np.zeros(len(means))
    shrunk = overall + share * (means - overall) if len(means) > 1 else means
    sure = np.sqrt(share) * errors if len(means) > 1 and between > 0 else errors
    return [
        UsualLevel(kind, name, count, float(m), float(e), float(np.sqrt(own_variance)), float(np.sqrt(between)))
        for (name, _, _, count), m, e in zip(known, shrunk, sure, strict=True)
    ]


def _moments(y: FloatArray, s: FloatArray) -> tuple[float, float, float]:
    """Mean, its standard deviation, and the variance beyond s (DerSimonian and Laird)."""
    w = 1 / np.maximum(s, 1e-12) ** 2
    mean = float(np.average(y, weights=w))
    if len(y) < 2:
        return mean, float(s[0]), 0.0
    q = float(np.sum(w * (y - mean) ** 2))
    variance = max(0.0, (q - (len(y) - 1)) / float(w.sum() - np.sum(w**2) / w.sum()))
    w = 1 / (s**2 + variance)
    return float(np.average(y, weights=w)), float(np.sqrt(1 / w.sum())), variance


def without_common_mode(
    found: FleetLevels, level: FloatArray, classes: np.ndarray, kinds: np.ndarray
) -> tuple[FloatArray, list[CommonMode]]:
    """Levels (V, N, P) less what the vehicles of a class did together, and what that was, sure or not."""
    rest, common = level.copy(), []
    with np.errstate(invalid="ignore"):
        own = np.nanmedian(np.where(np.isfinite(level), level, np.nan), axis=1, keepdims=True) if level.size else level
    parts = part_of(found.time)
    for name in dict.fromkeys(classes.tolist()):
        members = np.flatnonzero(classes == name)
        if len(members) < LEAST_VEHICLES:
            continue
        for kind in dict.fromkeys(kinds.tolist()):
            columns = np.flatnonzero(kinds == kind)
            for part in np.unique(parts[members][found.time[members] > 0]):
                at: BoolArray = (parts == part) & (found.time > 0) & (classes == name)[:, None]
                away = np.nanmean((level - own)[at][:, columns], axis=1) if at.any() else np.array([])
                away = away[np.isfinite(away)]
                if len(away) < LEAST_VEHICLES:
                    continue
                middle = float(np.median(away))
                spread = 1.2533 * 1.4826 * float(np.median(np.abs(away - middle))) / np.sqrt(len(away))
                rest[np.ix_(np.flatnonzero(at.any(axis=1)), np.arange(level.shape[1]), columns)] -= np.where(
                    at[at.any(axis=1)][:, :, None], middle, 0.0
                )
                warm = _mean(found.temperature[at]) if found.temperature is not None else np.nan
                common.append(CommonMode(str(name), str(kind), int(found.time[at].min()), middle, spread, warm))
    return rest, common


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def temperature_effects(modes: Sequence[CommonMode]) -> tuple[TemperatureEffect, ...]:
    """Lines of common modes over temperature, of classes and types where it is sure that there is one.

    Least squares over days, weighted by what is known of each; the scatter about the line counts where it is larger.
    """
    effects = []
    for name, kind in dict.fromkeys((one.vehicle_class, one.kind) for one in modes):
        own = [m for m in modes if (m.vehicle_class, m.kind) == (name, kind) and np.isfinite(m.temperature)]
        t, y = np.array([m.temperature for m in own]), np.array([m.change for m in own])
        if len(own) < LEAST_DAYS or np.ptp(t) < LEAST_KELVIN:
            continue
        w = 1 / np.maximum([m.std for m in own], LEAST_CHANGE) ** 2
        dt, dy = t - np.average(t, weights=w), y - np.average(y, weights=w)
        slope = float(np.sum(w * dt * dy) / np.sum(w * dt**2))
        excess = float(max(1.0, np.sum(w * (dy - slope * dt) ** 2) / (len(own) - 2)))
        std = float(np.sqrt(excess / np.sum(w * dt**2)))
        if abs(slope) > 3 * std:
            left = float(np.sum(w * (dy - slope * dt) ** 2) / np.sum(w * dy**2))
            effects.append(TemperatureEffect(name, kind, slope, std, 1 - left, len(own)))
    return tuple(effects)


def part_of(time: np.ndarray) -> np.ndarray:
    """Days since the epoch (N,) of times (N,), ns: what happens on one day happens together."""
    return time // int(DAY_NS)


def trends(time: np.ndarray, level: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slopes a day (V, P), their standard deviations, and the first level of each; NaN with too few points."""
    t = np.where(time > 0, time / DAY_NS, np.nan)[:, :, None] * np.ones_like(level)
    ok = np.isfinite(level) & np.isfinite(t)
    w = np.where(ok, 1 / np.maximum(std, 1e-9) ** 2, 0.0)
    count = ok.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = w.sum(axis=1)
        centre_t = np.nansum(w * np.nan_to_num(t), axis=1) / total
        centre_y = np.nansum(w * np.nan_to_num(level), axis=1) / total
        dt, dy = np.nan_to_num(t - centre_t[:, None]), np.nan_to_num(level - centre_y[:, None])
        spread = (w * dt**2).sum(axis=1)
        slope = (w * dt * dy).sum(axis=1) / spread
        residual = dy - slope[:, None] * dt
        excess = np.maximum(1.0, (w * residual**2).sum(axis=1) / np.maximum(count - 2, 1))
        slope_std = np.sqrt(excess / spread)
    few = (count < LEAST_POINTS) | ~(spread > 0)
    first = newest_of(level[:, ::-1])
    return np.where(few, np.nan, slope), np.where(few, np.nan, slope_std), first


def probability(days: float, moved: float, std: float, slope: float, slope_std: float, limit: float) -> float:
    """That the level is beyond its limit after `days`, on the side to which it goes."""
    if not np.isfinite(slope):
        return float("nan")
    side = np.sign(slope) or 1.0
    distance = limit - side * moved
    return float(ndtr((abs(slope) * days - distance) / np.sqrt(std**2 + (slope_std * days) ** 2)))


def crossing_days(moved: float, std: float, slope: float, slope_std: float, limit: float) -> tuple[float | None, ...]:
    """Days until the limit is crossed with 5, 50 and 95 %; None beyond the horizon."""
    if not np.isfinite(slope):
        return (None,) * len(QUANTILES)
    grid = np.concatenate([[0.0], np.geomspace(0.1, HORIZON_DAYS, 400)])
    crossed = np.maximum.accumulate([probability(t, moved, std, slope, slope_std, limit) for t in grid])
    return tuple(
        float(np.interp(q, crossed, grid)) if crossed[-1] >= q > crossed[0] else (0.0 if crossed[0] >= q else None)
        for q in QUANTILES
    )
