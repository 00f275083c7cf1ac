"""Loads of bodies in the belief: update by a window, reset at a stop, and whether a window contradicts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.signals import Deviating, FloatArray
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.filter import Belief

STOPPED = 5.0  # s without a used window after which passengers may have boarded


def update(belief: Belief, model: DeviationModel, found: Deviating, share: float) -> Belief:
    """Belief after a window with information on loads and constants of bodies only."""
    at = model.refined_at
    rows = at + len(belief.mean) - model.size
    M = found.information[at][:, at] * share
    u = found.score[at] * share - M @ (belief.mean[rows] - found.point[at])
    across = belief.covariance[:, rows]
    gain = np.linalg.solve(np.eye(len(at)) + M @ across[rows], np.column_stack([u, M]))
    covariance = belief.covariance - across @ gain[:, 1:] @ across.T
    return replace(belief, mean=belief.mean + across @ gain[:, 0], covariance=0.5 * (covariance + covariance.T))


def reset(
    belief: Belief, model: DeviationModel, mean: FloatArray | None = None, variance: FloatArray | None = None
) -> Belief:
    """Belief after a stop: loads at their prior, or with masses of known `mean` and `variance` (L,)."""
    covariance, state = belief.covariance.copy(), belief.mean.copy()
    first = len(belief.mean) - model.size
    at = model.cargo_at + first
    covariance[at, :] = covariance[:, at] = 0.0
    state[at], covariance[at, at] = 0.0, np.diag(model.prior)[model.cargo]
    if mean is not None and variance is not None:
        masses = model.loads_at + first
        state[masses], covariance[masses, masses] = mean, variance
    return replace(belief, mean=state, covariance=covariance)


def contradicted(belief: Belief, model: DeviationModel, found: Deviating) -> bool:
    """Whether a window contradicts the believed loads: something was loaded or unloaded without a stop."""
    at, along = model.cargo_at, model.refined_at
    if not len(at):
        return False
    values, vectors = np.linalg.eigh(found.information[at][:, at])
    observed = values > 1e-9 * max(float(values[-1]), 1e-300)
    root = vectors[:, observed] / np.sqrt(values[observed])  # observable directions; constants of bodies as believed
    rows = along + len(belief.mean) - model.size
    M = root.T @ found.information[at][:, along]
    seen = M @ (found.point[along] - belief.mean[rows]) + root.T @ found.score[at]
    spread = np.eye(len(seen)) + M @ belief.covariance[rows][:, rows] @ M.T
    return bool(seen @ np.linalg.solve(spread, seen) > model.rules.load**2)
