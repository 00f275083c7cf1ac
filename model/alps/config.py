"""Sizes and settings of the paper's networks.  The paper gives none of them: every value here is ours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Method = Literal["alps", "no_fourier", "no_attention", "autoencoder", "cdm"]
METHODS: tuple[Method, ...] = ("alps", "no_fourier", "no_attention", "autoencoder", "cdm")
Budget = Literal["quick", "full"]


@dataclass(frozen=True)
class NetworkConfig:
    """Layer sizes, the same for every method so that they are comparable."""

    convolution: tuple[int, int] = (16, 16)  # channels; kernel 8 stride 4, then kernel 3 stride 1
    deconvolution: tuple[int, int, int] = (32, 16, 8)  # channels from 8 x 8 up to 64 x 64
    embedding: int = 32  # (column, row) of each of 16 feature points
    width: int = 64  # d of the attention
    heads: int = 4
    layers: int = 2
    estimator: tuple[int, int] = (128, 64)
    decoder: int = 128


@dataclass(frozen=True)
class TrainingConfig:
    """One training run.  `horizons` (shooting lengths, samples) divide WINDOW - 1; the last is the paper's."""

    seed: int = 0
    trajectories: int = 150  # for training
    test_trajectories: int = 60
    updates: int = 400
    batch: int = 16
    learning_rate: float = 2e-3
    checkpoint_every: int = 100
    frame_updates: int = 250  # of the frame autoencoder, shared by every method of a task
    frame_batch: int = 64
    end_to_end: bool = False  # train the convolutions with the rest, not only in the frame autoencoder
    horizons: tuple[int, ...] = (3, 9, 33, 99)
    shares: tuple[float, ...] = (0.15, 0.2, 0.3, 0.35)  # of the updates spent at each horizon
    warm_up: float = 0.35  # share of the updates with the parameters held at mid-range
    divergence_start: float = 0.1  # weight of the KL (summed over states, mean over samples): large at first, so
    divergence_weight: float = 1e-3  # that the prior fixes origin and size, then small, so that states are sharp
    divergence_share: float = 0.35  # of the updates over which it falls
    observation_weight: float = 1.0  # squared error of the standardised embedding, mean
    pixel_weight: float = 20.0  # squared error of pixels in [0, 1], mean; end_to_end only
    state_weight: float = 1.0  # squared error of the chart, summed over its columns, mean over samples

    def horizon(self, step: int) -> int:
        """Shooting length at an update."""
        reached = 0.0
        for horizon, share in zip(self.horizons, self.shares, strict=True):
            reached += share * self.updates
            if step < reached:
                return horizon
        return self.horizons[-1]

    def divergence(self, step: int) -> float:
        """Weight of the KL at an update: geometric fall, then constant."""
        share = min(1.0, step / max(1.0, self.divergence_share * self.updates))
        return self.divergence_start * (self.divergence_weight / self.divergence_start) ** share


_QUICK = {
    "pendulum": TrainingConfig(warm_up=0.5, divergence_start=0.03, state_weight=0.2),
    "mass_spring_damper": TrainingConfig(
        horizons=(33, 99), shares=(0.4, 0.6), warm_up=0.5, divergence_start=0.01, state_weight=0.2
    ),
    "two_body": TrainingConfig(shares=(0.2, 0.2, 0.3, 0.3), warm_up=0.5, divergence_start=1e-3),
}


def training_config(task: str, budget: Budget, seed: int) -> TrainingConfig:
    """Settings of a visual task.  `full` is meant for one GPU."""
    config = replace(_QUICK[task], seed=seed)
    if budget == "quick":
        return config
    return replace(
        config,
        trajectories=500,
        test_trajectories=500,
        updates=20_000,
        batch=32,
        learning_rate=1e-3,
        frame_updates=4000,
        end_to_end=True,
    )
