"""Effects of load, temperature and speed on healthy springs and dampers, and changes common to all of a kind.

A parameter's healthy value is b + (s_kind + s)' x: its own baseline, and slopes over the conditions x, measured from
those in which the baseline was learned.  Slopes are learned from the vehicle's own first weeks by Bayesian linear
regression, those of a kind from the median of its elements, those of a parameter from its difference to its kind; the
prior comes from physics (oil thins by 0.2 % per kelvin, rubber stiffens in the cold) or from other vehicles.
The remaining change that is common to all elements of a kind is tracked as one level (air temperature that is not
measured, oil that warms up).  Elements are compared with their kind: weather raises no alarm of a single element, and
an element that differs from the others is detected.

P parameters, G groups of like elements, K = 3 conditions: temperature in 10 K, logarithm of the loaded mass over the
empty one, speed in 10 m/s.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.signals import BoolArray, Conditions, FloatArray, IntArray
from sprung.model.tracking.median import median
from sprung.model.tracking.rules import TRACKING_RULES, WeatherRules

CONDITIONS = 3
KELVIN, SPEED = 10.0, 10.0  # units of the conditions
FEWEST = 4  # elements of a kind: with fewer, a median is not robust
ALIKE = 1.5  # ratio of nominal values within which elements of a quantity are of one kind
MOST_OF = 0.75  # of a kind that must move together
FEWEST_VEHICLES = 3  # that must have learned a slope before it becomes a prior of others
FIRST_WEEKS = 21 * 86400.0  # s in which slopes are learned
CORRELATED = 600.0, 0.005  # correlation time in s, and standard deviation, of errors that a ride's windows share
OF_KINDS = 3600.0, 0.01  # the same for a kind: oil and air temperature differ
COMMON_WALK = 0.005 / math.sqrt(600.0)  # per sqrt(s), random walk of a kind's common level while the vehicle runs
PAUSE_WALK = 0.02 / math.sqrt(3600.0)  # per sqrt(s), while it stands
MAX_PAUSE = 0.08  # largest change during a pause
SETTLING = 6 * 3600.0  # s, time constant with which the settled level follows the common level
NEAR = 0.025  # log-ratio about a kind's median: elements within this, or within their errors, move with it
_NOTHING = np.zeros(1)


@dataclass(frozen=True, eq=False)
class WeatherModel:
    """Constants of one system."""

    group: IntArray  # of each parameter; -1: too few like it, shape (P,)
    mean: FloatArray  # of [offset, slopes], in a kind relative to the kind's, shape (P, 1 + K)
    std: FloatArray  # shape (P, 1 + K)
    kind_mean: FloatArray  # of kinds, shape (G, 1 + K)
    kind_std: FloatArray  # shape (G, 1 + K)
    most: FloatArray  # largest log-ratio of a kind that weather can explain, shape (G,)
    rules: WeatherRules = TRACKING_RULES.weather

    @cached_property
    def groups(self) -> int:
        return int(self.group.max(initial=-1)) + 1

    @cached_property
    def members(self) -> tuple[IntArray, ...]:
        """Parameters of every kind."""
        return tuple(np.flatnonzero(self.group == g) for g in range(self.groups))

    def of_kinds(self, values: FloatArray) -> FloatArray:
        """The value (G,) of each parameter's kind, 0 where it has none, shape (P,)."""
        return np.concatenate((values, _NOTHING))[self.group]  # group -1 is the last


@dataclass(frozen=True, slots=True, eq=False)
class Weather:
    """Posterior of the slopes, and the common levels of the kinds."""

    mean: FloatArray  # of [offset, slopes], shape (P, 1 + K)
    covariance: FloatArray  # shape (P, 1 + K, 1 + K)
    kind_mean: FloatArray  # shape (G, 1 + K)
    kind_covariance: FloatArray  # shape (G, 1 + K, 1 + K)
    reference: FloatArray  # conditions in which the baseline was learned, shape (K,)
    weight: FloatArray  # windows in that mean, shape (K,)
    common: FloatArray  # log-ratio common to all of a kind beyond the slopes, shape (G,)
    variance: FloatArray  # shape (G,)
    settled: FloatArray  # the slow part of it, shape (G,)
    slack: FloatArray  # additional difference allowed between both after a pause, shape (G,)
    began: IntArray  # ns, of the first window, and of the last, shape (2,); 0: none
    effect: FloatArray  # of the conditions of the last window on each parameter, shape (P,)
    doubt: FloatArray  # its variance, shape (P,)
    warmth: FloatArray  # the last temperature that was measured, 10 K; NaN: none, shape (1,)
    shared: FloatArray  # correlation of what windows have in common with that in the baseline, shape (1,)

    def shifted(self, by: int) -> Weather:
        """With times that are later by `by`, ns."""
        return replace(self, began=np.where(self.began != 0, self.began + by, 0))


def model_of(
    names: Sequence[str],
    nominal: Sequence[float],
    by_load: Collection[str] = (),
    rules: WeatherRules = TRACKING_RULES.weather,
) -> WeatherModel:
    """From parameters' names and nominal values; `by_load`: elements whose stiffness is proportional to the load."""
    group = _groups(names, nominal)
    G = int(group.max(initial=-1)) + 1
    mean, std = np.zeros((len(names), 1 + CONDITIONS)), np.zeros((len(names), 1 + CONDITIONS))
    kind_mean, kind_std = np.zeros((G, 1 + CONDITIONS)), np.zeros((G, 1 + CONDITIONS))
    for i, name in enumerate(names):
        element, _, quantity = name.rpartition(".")
        air = element in by_load and quantity == "stiffness"
        physics = 0.0, {"damping": -0.02, "stiffness": 0.0 if air else -0.005}.get(quantity, 0.0), float(air), 0.0
        open_ = 0.01, {"damping": 0.01, "stiffness": 0.006}.get(quantity, 0.003), 0.2 if air else 0.05, 0.004
        std[i] = 0.005, {"damping": 0.003, "stiffness": 0.002}.get(quantity, 0.001), 0.05 if air else 0.01, 0.002
        if group[i] < 0:  # no others of its kind to compare with
            mean[i], std[i] = physics, np.hypot(std[i], np.multiply(open_, [0, 1, 1, 1]))
        else:
            kind_mean[group[i]], kind_std[group[i]] = physics, open_
    reach = {"damping": rules.damping, "stiffness": rules.stiffness}
    most = [reach.get(names[int(np.argmax(group == g))].rpartition(".")[2], rules.others) for g in range(G)]
    return WeatherModel(group, mean, std, kind_mean, kind_std, np.array(most, dtype=np.float64), rules)


def _groups(names: Sequence[str], nominal: Sequence[float]) -> IntArray:
    """Elements of one quantity with like nominal values are of one kind."""
    group = np.full(len(names), -1, dtype=np.int64)
    quantities = [name.rpartition(".")[2] for name in names]
    found = 0
    for quantity in dict.fromkeys(quantities):
        rows = [i for i, q in enumerate(quantities) if q == quantity and nominal[i] > 0]
        rows.sort(key=lambda i: nominal[i])
        cuts = [k for k in range(1, len(rows)) if nominal[rows[k]] > ALIKE * nominal[rows[k - 1]]]
        for first, last in zip([0, *cuts], [*cuts, len(rows)], strict=True):
            if last - first >= FEWEST:
                group[rows[first:last]] = found
                found += 1
    return group


def start(model: WeatherModel) -> Weather:
    """Nothing seen yet."""
    P, G = len(model.group), model.groups
    covariances = [np.einsum("pi,ij->pij", std**2, np.eye(1 + CONDITIONS)) for std in (model.std, model.kind_std)]
    return Weather(
        model.mean.copy(), covariances[0], model.kind_mean.copy(), covariances[1], np.zeros(CONDITIONS),
        np.zeros(CONDITIONS), np.zeros(G), np.zeros(G), np.zeros(G), np.zeros(G), np.zeros(2, dtype=np.int64),
        np.zeros(P), np.zeros(P), np.full(1, math.nan), np.ones(1),
    )  # fmt: skip


def reset_offsets(weather: Weather, model: WeatherModel, rows: BoolArray) -> Weather:
    """After a repair of the parameters `rows` (P,): offsets return to their prior, slopes are kept.

    The common level of a kind is reset if all of its elements are.
    """
    mean, covariance = weather.mean.copy(), weather.covariance.copy()
    mean[rows, 0] = 0.0
    covariance[rows, 0, :] = covariance[rows, :, 0] = 0.0
    covariance[rows, 0, 0] = model.std[rows, 0] ** 2
    whole = np.array([bool(rows[members].all()) for members in model.members], dtype=bool)
    fresh = {n: np.where(whole, 0.0, getattr(weather, n)) for n in ("common", "variance", "settled", "slack")}
    return replace(weather, mean=mean, covariance=covariance, **fresh)


def features(weather: Weather, conditions: Conditions | None, load: float | None) -> FloatArray:
    """Conditions (K,), NaN where unknown; `load`: logarithm of the loaded mass over the empty one.

    After the loss of a temperature probe the last measured temperature is kept; later effects of weather are tracked
    by the common level, as without a probe.
    """
    temperature = math.nan if conditions is None else conditions.temperature
    warmth = temperature / KELVIN if math.isfinite(temperature) else float(weather.warmth[0])
    speed = math.nan if conditions is None else conditions.speed
    return np.array([warmth, math.nan if load is None else load, speed / SPEED])


def ridden(weather: Weather, seconds: float, *, learning: bool, departs: bool) -> Weather:
    """`weather` so many seconds of a ride later.

    learning: the baseline is being learned.  departs: from a stop, after which what windows have in common is another.
    """
    shared = 1.0 if learning else 0.0 if departs else float(weather.shared[0]) * math.exp(-seconds / CORRELATED[0])
    return replace(weather, shared=np.full(1, shared))


def _of_offset(weather: Weather) -> float:
    """Share of its offset that a parameter has by now: what windows have in common is part of the baseline, too, and
    goes astray from it only as fast as it changes."""
    return math.sqrt(1.0 - float(weather.shared[0]) ** 2)


def at_conditions(weather: Weather, model: WeatherModel, at: FloatArray, *, learning: bool) -> Weather:
    """`weather` with the effect of conditions `at` (K,); `learning`: the baseline is being learned under them.

    The offset corrects the baseline itself: it is part of the effect and of its variance.
    """
    weather = replace(weather, warmth=at[:1])
    known = np.isfinite(at)
    if learning or np.any(known & (weather.weight == 0)):
        taken = known & (learning | (weather.weight == 0))
        weight = weather.weight + taken
        moved = np.where(taken, np.where(known, at, 0.0) - weather.reference, 0.0) / np.maximum(weight, 1)
        weather = replace(weather, reference=weather.reference + moved, weight=weight)
    x = np.concatenate([[_of_offset(weather)], np.where(known, at - weather.reference, 0.0)])
    kinds = weather.kind_mean[:, 1:] @ x[1:]  # a kind's own offset is part of its common level
    return replace(weather, effect=weather.mean @ x + model.of_kinds(kinds), doubt=(weather.covariance @ x) @ x)


def update_slopes(
    weather: Weather,
    model: WeatherModel,
    residual: FloatArray,  # log-ratios less baseline, before any effect, shape (P,)
    variance: FloatArray,  # of one window's, independent, shape (P,)
    usable: BoolArray,  # measured, with a baseline, and without evidence for a change, shape (P,)
    at: FloatArray,  # conditions, shape (K,)
    time: int,  # ns
    seconds: float,  # of signal that no earlier window held
) -> Weather:
    """Slopes after one window."""
    in_time = (time - int(weather.began[0])) * 1e-9 < FIRST_WEEKS
    if not in_time or not usable.any():
        return weather
    x = np.concatenate([[_of_offset(weather)], np.where(np.isfinite(at), at - weather.reference, 0.0)])
    own = residual - common_effect(weather, model) - (weather.effect - weather.mean @ x)
    mean, covariance = _regressed(
        weather.mean, weather.covariance, x, own, _floored(variance, CORRELATED, seconds), usable
    )
    weather = replace(weather, mean=mean, covariance=covariance)
    if not model.groups or not np.isfinite(at).any():
        return weather
    middle, noise, fit = (np.zeros(model.groups) for _ in range(3))
    without = residual - weather.mean @ x
    for g, members in enumerate(model.members):
        rows = members[usable[members]]
        if len(rows) >= FEWEST:
            middle[g], fit[g] = median(without[rows]), 1.0
            noise[g] = 1.57 * variance[rows].sum() / len(rows) ** 2
    mean, covariance = _regressed(
        weather.kind_mean, weather.kind_covariance, x, middle, _floored(noise, OF_KINDS, seconds), fit > 0
    )
    return replace(weather, kind_mean=mean, kind_covariance=covariance)


def _floored(variance: FloatArray, correlated: tuple[float, float], seconds: float) -> FloatArray:
    length, floor = correlated
    return np.maximum(variance, floor**2 * length / max(seconds, 1e-3))


def _regressed(
    mean: FloatArray, covariance: FloatArray, x: FloatArray, value: FloatArray, noise: FloatArray, usable: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """One step of linear regression in every row: value = mean' x + noise."""
    across = covariance @ x  # (rows, 1 + K)
    total = across @ x + noise
    off = value - mean @ x
    fits = usable & (np.abs(off) < 4.0 * np.sqrt(total))
    gain = np.where(fits[:, None], across / total[:, None], 0.0)
    covariance = covariance - gain[:, :, None] * across[:, None, :]
    return mean + gain * off[:, None], 0.5 * (covariance + covariance.transpose(0, 2, 1))


def update_common(
    weather: Weather, model: WeatherModel, residual: FloatArray, variance: FloatArray, usable: BoolArray, time: int
) -> Weather:
    """Common levels after one window at `time`, ns: the median of a kind is tracked while most elements are near it.

    residual: log-ratios less baseline, shape (P,), with `variance`; usable: measured, with a baseline.
    """
    elapsed = (time - int(weather.began[1])) * 1e-9 if weather.began[1] else 0.0
    weather = replace(weather, began=np.array([weather.began[0] or time, time]))
    residual, variance = residual - weather.effect, variance + weather.doubt
    common, spread = weather.common.copy(), weather.variance.copy()
    rest = min(PAUSE_WALK**2 * max(elapsed - 60.0, 0.0), MAX_PAUSE**2)
    spread += COMMON_WALK**2 * min(elapsed, 60.0) + rest
    reach = np.maximum(NEAR, 3 * np.sqrt(variance))
    for g, members in enumerate(model.members):
        rows = members[usable[members]]
        if len(rows) < FEWEST:
            continue
        middle = median(residual[rows])
        near = np.abs(residual[rows] - middle) < reach[rows]
        if np.count_nonzero(near) < MOST_OF * len(rows):
            continue
        noise = 1.57 * float(variance[rows].sum()) / len(rows) ** 2  # of a median
        gain = spread[g] / (spread[g] + noise)
        common[g] += gain * (middle - common[g])
        spread[g] *= 1 - gain
    weather = replace(weather, common=common, variance=spread)
    slack = np.minimum(weather.slack * math.exp(-min(elapsed, 60.0) / SETTLING) + math.sqrt(rest), MAX_PAUSE)
    part = -math.expm1(-elapsed / SETTLING)
    slow = np.abs(common - weather.settled) < model.rules.fast + slack  # faster changes are no weather and never settle
    settled = weather.settled + np.where(slow, part * (common - weather.settled), 0.0)
    return replace(weather, settled=settled, slack=slack)


def common_effect(weather: Weather, model: WeatherModel) -> FloatArray:
    """Common level of each parameter's kind, shape (P,)."""
    return model.of_kinds(weather.common)


def settled_effect(weather: Weather, model: WeatherModel) -> FloatArray:
    """Slow part of the common level, attributed to weather, shape (P,)."""
    return model.of_kinds(weather.settled)


def beyond_weather(weather: Weather, model: WeatherModel, share: float = 1.0) -> BoolArray:
    """Kinds that changed faster or further than weather can explain, shape (G,); `share` of the limits."""
    certain = model.rules.certain * np.sqrt(weather.variance)
    fast = np.abs(weather.common - weather.settled) > share * (model.rules.fast + weather.slack) + certain
    return np.asarray(fast | (np.abs(weather.common) > share * model.most + certain))


def pooled(model: WeatherModel, found: Sequence[Weather]) -> WeatherModel:
    """Prior of a new vehicle from others of the same system: mean and standard deviation of their slopes.

    Elements of a kind are pooled, too.  A slope that no vehicle has learned keeps the prior from physics.
    """
    if not found:
        return model
    mean, std = _spread(model.mean, model.std, [(w.mean, w.covariance) for w in found], _kinds(model))
    rows = [np.array([g]) for g in range(model.groups)]
    kind_mean, kind_std = _spread(
        model.kind_mean, model.kind_std, [(w.kind_mean, w.kind_covariance) for w in found], rows
    )
    return replace(model, mean=mean, std=std, kind_mean=kind_mean, kind_std=kind_std)


def _spread(
    mean: FloatArray, std: FloatArray, found: Sequence[tuple[FloatArray, FloatArray]], groups: Sequence[IntArray]
) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of slopes over vehicles, and over the rows of one group."""
    mean, std = mean.copy(), std.copy()
    means = np.array([m for m, _ in found])  # (V, rows, 1 + K)
    variances = np.array([np.diagonal(c, axis1=1, axis2=2) for _, c in found])
    informed = variances < 0.5 * std**2
    for rows in groups:
        for k in range(1, 1 + CONDITIONS):
            chosen = informed[:, rows, k]
            if chosen.sum() < FEWEST_VEHICLES:
                continue
            values, weight = means[:, rows, k][chosen], 1 / variances[:, rows, k][chosen]
            middle = float(np.sum(weight * values) / weight.sum())
            between = max(float(np.var(values)) - float(np.mean(1 / weight)), 0.0)
            mean[rows, k] = middle
            std[rows, k] = np.minimum(std[rows, k], math.sqrt(between + 1 / float(weight.sum())) + 0.1 * std[rows, k])
    return mean, std


def _kinds(model: WeatherModel) -> list[IntArray]:
    """Rows of parameters that are pooled: those of a kind together, every other one alone."""
    alone = [np.array([i]) for i in np.flatnonzero(model.group < 0)]
    return [*model.members, *alone]
