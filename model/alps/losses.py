"""The paper's three-term loss, with weights that put the terms on one scale."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from model.alps.config import TrainingConfig
from model.alps.network import Passed
from model.alps.task import Task


@dataclass(frozen=True)
class Loss:
    """Total and parts, each a mean over windows and samples."""

    total: Tensor
    divergence: Tensor
    observation: Tensor
    state: Tensor


def loss_of(task: Task, passed: Passed, embeddings: Tensor, config: TrainingConfig, divergence_weight: float) -> Loss:
    """KL + |o - decoded(simulated)|^2 + |encoded - simulated|^2, on embeddings (B, T, E).

    The paper sums over the window; means keep the weights independent of its length.  The simulated states are the
    encoded ones where a method has no dynamics, so that its last term is zero.
    """
    divergence = passed.encoded.divergence.mean()
    observation = (passed.observed - embeddings).square().mean()
    gap = task.to_chart(passed.encoded.draw) - task.to_chart(passed.simulated)
    state = gap.square().sum(-1).mean()
    total = divergence_weight * divergence + config.observation_weight * observation + config.state_weight * state
    return Loss(total, divergence, observation, state)


def picture_loss(drawn: Tensor, pictures: Tensor) -> Tensor:
    """Mean squared error of pixels in [0, 1]."""
    return torch.nn.functional.mse_loss(drawn, pictures)
