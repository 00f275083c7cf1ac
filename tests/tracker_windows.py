"""Window estimates drawn with known parameters and with the errors that their covariances state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sprung.model.signals import Estimate, FloatArray
from sprung.model.tracking.tracker import Tracker, TrackerSettings

EPOCH = 1_790_000_000_000_000_000
WINDOW_STD = np.repeat([0.004, 0.006, 0.02, 0.01], [8, 4, 8, 4])  # a vehicle's 8 + 4 stiffnesses and dampings
Truth = Callable[[float], FloatArray]
Stream = list[tuple[Estimate, int]]


@dataclass(frozen=True)
class TrackedParameter:
    name: str
    unit: str = "N/m"
    nominal: float = 1e6


def make_tracker(size: int = 24, settings: TrackerSettings | None = None) -> Tracker:
    return Tracker([TrackedParameter(f"element_{i}.stiffness") for i in range(size)], settings)


def correlated(rng: np.random.Generator, std: FloatArray = WINDOW_STD) -> FloatArray:
    """A covariance with standard deviations `std` and correlations up to about 0.5."""
    factor = rng.normal(size=(len(std), len(std)))
    mixed = factor @ factor.T
    scale = np.sqrt(np.diag(mixed))
    correlation = 0.5 * mixed / np.outer(scale, scale) + 0.5 * np.eye(len(std))
    return correlation * np.outer(std, std)


def estimate(value: FloatArray, covariance: FloatArray, **changes: object) -> Estimate:
    fields: dict[str, object] = {
        "identifiable": np.ones(len(value), dtype=bool),
        "nrmse": 0.03,
        "per_sensor": np.full(12, 0.03),
        "chi_square": 1.0,
        "adequate": True,
        "converged": True,
        "iterations": 3,
    }
    return Estimate(value, covariance, **(fields | changes))  # type: ignore[arg-type]


def windows(
    rng: np.random.Generator,
    truth: Truth,
    seconds: float,
    covariance: FloatArray,
    *,
    per_window: int = 2,
    scatter: float = 1.0,
    start: float = 0.0,
) -> Stream:
    """1-s windows, `per_window` of them a second; overlapping ones share the errors of what they share."""
    root = np.linalg.cholesky(covariance) * scatter
    pieces = rng.normal(size=(int(seconds * per_window) + per_window, len(covariance)))
    stream = []
    for k in range(int(seconds * per_window)):
        error = root @ pieces[k : k + per_window].sum(axis=0) / np.sqrt(per_window)
        time = start + k / per_window
        value = truth(time + 0.5) + error
        noise = np.exp(0.05 * rng.normal())
        stream.append((estimate(value, covariance, chi_square=noise), EPOCH + round(time * 1e9)))
    return stream


def constant(value: FloatArray) -> Truth:
    return lambda _time: value


def step(size: int, index: int, change: float, at: float, until: float = np.inf) -> Truth:
    def truth(time: float) -> FloatArray:
        value = np.zeros(size)
        if at <= time < until:
            value[index] = np.log1p(change)
        return value

    return truth
