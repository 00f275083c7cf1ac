"""From one observation to its embedding z': convolutional for pictures, feed-forward for sensors.

The convolutional embedding ends in feature points (spatial soft-argmax, Finn et al. 2016): each channel becomes a
distribution over the picture, whose mean column and row are two numbers of z'.  They move evenly with what they
follow, at a fraction of a pixel, which a state estimator needs.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig


class ConvolutionalEmbedding(nn.Module):
    """Pictures (M, 3, 64, 64) -> (M, embedding): 16 x 16 maps -> one feature point per channel."""

    axis: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, points = config.convolution
        if config.embedding != 2 * points:
            raise ValueError(f"embedding must be {2 * points}, two numbers per feature point, not {config.embedding}")
        self.maps = nn.Sequential(
            nn.Conv2d(3, first, 8, stride=4, padding=2), nn.ReLU(), nn.Conv2d(first, points, 3, padding=1)
        )
        self.sharpness = nn.Parameter(torch.full((points, 1), 4.0))
        self.register_buffer("axis", torch.linspace(-1, 1, 16))

    def forward(self, pictures: Tensor) -> Tensor:
        """(M, 3, 64, 64) -> (M, embedding)."""
        maps = self.maps(pictures)  # (M, K, 16, 16)
        share = torch.softmax(maps.flatten(2) * self.sharpness, dim=-1).unflatten(2, (16, 16))
        column = (share.sum(2) * self.axis).sum(-1)
        row = (share.sum(3) * self.axis).sum(-1)
        return torch.cat([column, row], dim=-1)


class FeedForwardEmbedding(nn.Sequential):
    """Sensor values (..., C) -> (..., embedding), a projection to more dimensions."""

    def __init__(self, channels: int, config: NetworkConfig) -> None:
        super().__init__(nn.Linear(channels, config.width), nn.ELU(), nn.Linear(config.width, config.embedding))


def positions(length: int, width: int) -> Tensor:
    """Sine and cosine position signal (length, width) of Vaswani et al. 2017."""
    place = torch.arange(length, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, width, 2, dtype=torch.float32) * (-math.log(10000.0) / width))
    signal = torch.zeros(length, width)
    signal[:, 0::2] = torch.sin(place * rate)
    signal[:, 1::2] = torch.cos(place * rate)
    return signal
