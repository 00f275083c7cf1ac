"""State of gains, delays and loads beside the filter's belief: sensitivities, reference of the baseline, jump test.

H deviations, V directions (`deviation_model`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import FloatArray, IntArray
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.filter import Belief

LATELY = 100  # windows that are searched for a drift, which the reference of a baseline may have followed until then


@dataclass(frozen=True, slots=True, eq=False)
class DeviationRecord:
    """State of the deviations that is not part of the filter's belief."""

    cross: FloatArray  # mean sensitivity of the log-ratios to the deviations, shape (P, H)
    base_cross: FloatArray  # the same over the windows of the baseline, shape (P, H)
    reference: FloatArray  # deviations while the baseline was learned, shape (H,)
    reference_variance: FloatArray  # of these, relative to the others of their group, shape (H,)
    following: FloatArray  # share of a correction of the belief that belongs to the reference, too, shape (H,)
    followed: FloatArray  # the belief that the reference has followed last, shape (H,)
    lately: FloatArray  # how far the reference has followed over the last LATELY windows, shape (H,)
    moved: FloatArray  # 1 where a deviation has jumped, or drifted away, since, shape (H,)
    origin: FloatArray  # gains and delays when they were first known, shape (H,); NaN: not yet
    slope: FloatArray  # recent evidence for a jump along each direction, shape (V,)
    curvature: FloatArray  # its information, shape (V,)
    trend: FloatArray  # evidence of the last windows, however weak, that a direction is followed late, shape (V,)
    trend_curvature: FloatArray  # its information, shape (V,)
    since: IntArray  # ns, when the evidence began to rise, shape (V,)
    excess: FloatArray  # part of chi-square that known deviations explain, mean over windows, shape (1,)
    recent: IntArray  # ns, the last windows with sensitivities of their own, shape (3,); 0: none

    @property
    def ratio(self) -> FloatArray:
        """Log-likelihood ratio of a jump along each direction, shape (V,)."""
        return np.asarray(self.slope**2 / (2 * np.maximum(self.curvature, 1e-12)))

    def shifted(self, by: int) -> DeviationRecord:
        """With times that are later by `by`, ns."""
        recent = np.where(self.recent != 0, self.recent + by, 0)
        return replace(self, since=self.since + by, recent=recent)

    def lag(self, model: DeviationModel) -> FloatArray:
        """How far the last windows lie beyond what is believed, along each direction, shape (V,)."""
        return np.asarray(self.trend / (self.trend_curvature + 1 / model.prior_along))


def start(parameters: int, model: DeviationModel) -> DeviationRecord:
    H, V = model.size, len(model.directions)
    zeros = np.zeros
    return DeviationRecord(
        cross=zeros((parameters, H)),
        base_cross=zeros((parameters, H)),
        reference=zeros(H),
        reference_variance=model.relative_variance(model.prior),
        following=np.ones(H),
        followed=zeros(H),
        lately=zeros(H),
        moved=zeros(H),
        origin=np.full(H, np.nan),
        slope=zeros(V),
        curvature=zeros(V),
        trend=zeros(V),
        trend_curvature=zeros(V),
        since=zeros(V, dtype=np.int64),
        excess=zeros(1),
        recent=zeros(3, dtype=np.int64),
    )


def extended(record: DeviationRecord, belief: Belief, model: DeviationModel) -> tuple[DeviationRecord, Belief]:
    """An older state, extended by the model's deviations and directions that it does not have yet."""
    old, H, V = belief.deviations, model.size, len(model.directions)
    zeros = np.zeros(V)
    if np.isnan(record.following).any():
        record = _of_fixed_reference(record, model, belief)
    if len(record.slope) != V:
        record = replace(
            record, slope=zeros, curvature=zeros, trend=zeros, trend_curvature=zeros, since=zeros.astype(np.int64)
        )
    if old >= H:
        return record, belief
    more, first = H - old, len(belief.mean)
    covariance = np.zeros((first + more, first + more))
    covariance[:first, :first] = belief.covariance
    covariance[first:, first:] = model.prior[old:, old:]
    wider = {name: np.pad(getattr(record, name), ((0, 0), (0, more))) for name in ("cross", "base_cross")}
    fresh = start(len(record.cross), model)
    longer = {
        name: np.append(getattr(record, name), getattr(fresh, name)[old:])
        for name in ("reference", "reference_variance", "following", "followed", "lately", "moved", "origin")
    }
    return (
        replace(record, **wider, **longer),
        Belief(np.pad(belief.mean, (0, more)), covariance, H),
    )


def _of_fixed_reference(record: DeviationRecord, model: DeviationModel, belief: Belief) -> DeviationRecord:
    """An older state's record: its reference was the belief for ten minutes, up to a drift that was not seen."""
    old = belief.deviations
    unseen = np.where(np.isfinite(model.drift_limit), model.rules.drifted / 3 * model.drift_limit, 0.0)[:old] ** 2
    zeros = np.zeros(old)
    return replace(
        record, reference_variance=unseen, following=zeros, followed=belief.mean[len(belief.mean) - old :], lately=zeros
    )
