"""Sequential test for jumps of gains, delays and loads.

It uses only the information on deviations that remains after the parameters are profiled out, so that a changed spring
is not mistaken for a sensor fault.  H deviations, V directions (`deviation_model`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.deviation_record import LATELY, DeviationRecord
from sprung.model.tracking.filter import Belief

_TREND_MOST = 2.0  # deviations of one window at most: one alone is no drift
_RIVALS = 2  # that are named beside a jump


@dataclass(frozen=True, slots=True)
class Jump:
    """A deviation that has jumped."""

    direction: FloatArray  # shape (H,)
    size: float
    std: float
    since: int  # ns
    kind: str
    rivals: tuple[FloatArray, ...] = ()  # other directions that explain the same windows about as well, each (H,)


def tested_for_jumps(
    calibration: DeviationRecord,
    model: DeviationModel,
    along: FloatArray,
    information: FloatArray,
    bounded: float,
    time: int,
) -> tuple[DeviationRecord, Jump | None]:
    """Test statistics after a window whose scores are scaled by `bounded`, and a significant jump."""
    # Directions without evidence restart: quiet windows before a jump must not outweigh it.
    old, rules = calibration.slope, model.rules
    lasting = old**2 > 2 * calibration.curvature * rules.restart
    keep = np.where(lasting & (old * (rules.forgetting * old + along * bounded) > 0), rules.forgetting, 0.0)
    slope = keep * old + along * bounded
    curvature = keep * calibration.curvature + information
    side = along * np.minimum(1.0, _TREND_MOST * np.sqrt(information) / np.maximum(np.abs(along), 1e-300))
    trend = (1 - 1 / LATELY) * calibration.trend + side
    trend_curvature = (1 - 1 / LATELY) * calibration.trend_curvature + information
    ratio = slope**2 / (2 * curvature)
    since = np.where((ratio >= rules.onset) & (calibration.ratio < rules.onset), time, calibration.since)
    best = int(np.argmax(ratio)) if len(ratio) else -1
    jump = None
    if best >= 0 and ratio[best] >= rules.evidence:
        direction = model.directions[best]
        kind = model.kind_along(direction)
        score, by = (slope[best], curvature[best]) if bounded == 1.0 else (along[best], information[best])
        others = rivals(model, ratio, slope / curvature, best)
        jump = Jump(direction, float(score / by), float(by**-0.5), int(since[best]), kind, others)
        slope = curvature = trend = trend_curvature = np.zeros_like(slope)
    return (
        replace(
            calibration, slope=slope, curvature=curvature, trend=trend, trend_curvature=trend_curvature, since=since
        ),
        jump,
    )


def rivals(model: DeviationModel, ratio: FloatArray, size: FloatArray, best: int) -> tuple[FloatArray, ...]:
    """Directions of other channels than the `best` one whose jump explains the windows about as well, best first.

    ratio, size: of a jump along each direction, (V,).  Only differences between channels are determined: wheels of a
    bogie that are late may look like sensors of that bogie that are early.
    """
    found = [model.directions[best]]
    for v in np.argsort(-ratio).tolist():
        if ratio[v] < ratio[best] - model.rules.rival or len(found) > _RIVALS:
            break
        direction = model.directions[v]
        kind = model.kind_along(direction)
        apart = not any(np.any((direction != 0) & (other != 0)) for other in found)
        if apart and kind in ("gain", "delay") and abs(size[v]) >= model.jump_limit(kind):
            found.append(direction)
    return tuple(found[1:])


def reopen_jumped(belief: Belief, model: DeviationModel, cross: FloatArray, jump: Jump) -> Belief:
    """Belief after a jump: variance is added to the deviation, and to the parameters that had absorbed part of it."""
    H = model.size
    open_ = np.zeros(len(belief.mean))
    open_[-H:] = 2 * jump.size * jump.direction
    taken = np.zeros(len(belief.mean))
    taken[: belief.size] = cross @ jump.direction * jump.size
    return replace(belief, covariance=belief.covariance + np.outer(open_, open_) + np.outer(taken, taken))
