"""The paper's three-term loss, with weights that put the terms on one scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sprung.model.alps.config import TrainingConfig
from sprung.model.alps.network import Passed
from sprung.model.alps.task import Task


@dataclass(frozen=True)
class Loss:
    """Total and parts, each a mean over windows and samples."""

    total: Tensor
    divergence: Tensor
    observation: Tensor
    state: Tensor


def loss_of(task: Task, passed: Passed, embeddings: Tensor, config: TrainingConfig, divergence_weight: float) -> Loss:
    """KL + |o - decoded(simulated)|^2 + |encoded - simulated|^2, on embeddings (B, T, E).

    The paper sums over the window; means keep the weights independent of its length.  Both errors are `tempered`.  The
    simulated states are the encoded ones where a method has no dynamics, so that its last term is zero.  Where it has
    no decoder, `spread_loss` takes the place of the middle term.
    """
    divergence = passed.encoded.divergence.mean()
    if passed.observed is None:
        observation = config.spread_weight * spread_loss(task, passed.encoded.mean)
    else:
        observation = tempered((passed.observed - embeddings).square().mean(-1), config.outlier)
    state = state_loss(task, passed.encoded.draw, passed.simulated, config.outlier)
    total = divergence_weight * divergence + config.observation_weight * observation + config.state_weight * state
    return Loss(total, divergence, observation, state)


def spread_loss(task: Task, encoded: Tensor) -> Tensor:
    """KL from the batch's distribution of each position (B, T, N), taken as Gaussian, to the unit one.

    Without a picture to draw, positions that never move satisfy every equation of motion at rest; this keeps the
    latent from collapsing (Castaneda Garcia et al. 2025).  Angles are on their circle anyway.
    """
    places = [index for index in task.placed if index not in task.angles]
    if not places:
        return encoded.new_zeros(())
    seen = torch.stack([encoded[..., index] / task.state_scale[index] for index in places], -1).flatten(0, 1)
    mean, variance = seen.mean(0), seen.var(0).clamp_min(1e-8)
    return 0.5 * (mean.square() + variance - 1 - variance.log()).sum()


def state_loss(task: Task, encoded: Tensor, simulated: Tensor, outlier: float) -> Tensor:
    """|encoded - simulated|^2 on the chart of the states, both (B, T, N)."""
    gap = task.to_chart(encoded) - task.to_chart(simulated)
    return tempered(gap.square().sum(-1), outlier)


def tempered(squared: Tensor, outlier: float) -> Tensor:
    """Mean of squared errors (B, T), each as a log(1 + e / a): a Cauchy likelihood.

    A simulation that falls to the other side of an unstable equilibrium is wrong by the size of the whole motion, and
    plain squares let such windows decide the parameters: damping makes them rarer.  An
    infinite a gives the plain mean.
    """
    if math.isinf(outlier):
        return squared.mean()
    return (outlier * torch.log1p(squared / outlier)).mean()


def picture_loss(drawn: Tensor, pictures: Tensor) -> Tensor:
    """Mean squared error of pixels in [0, 1], of two tensors of one shape (...)."""
    return torch.nn.functional.mse_loss(drawn, pictures)
