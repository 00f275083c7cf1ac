"""From one state to its observation: deconvolutional for pictures, feed-forward for sensors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig


class DeconvolutionalDecoder(nn.Module):
    """Embedding (M, E) -> picture (M, 3, 64, 64)."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, second, third = config.deconvolution
        self.net = nn.Sequential(
            nn.Linear(config.embedding, 64), nn.ReLU(), nn.Linear(64, first * 64), nn.ReLU(),
            nn.Unflatten(1, (first, 8, 8)),
            nn.ConvTranspose2d(first, second, 4, 2, 1), nn.ReLU(),
            nn.ConvTranspose2d(second, third, 4, 2, 1), nn.ReLU(),
            nn.ConvTranspose2d(third, 3, 4, 2, 1),
        )  # fmt: skip

    def forward(self, embeddings: Tensor) -> Tensor:
        """(M, E) -> (M, 3, 64, 64)."""
        return torch.sigmoid(self.net(embeddings) - 2)  # most of a picture is background


class StateDecoder(nn.Module):
    """Chart of a state (..., C) -> embedding or sensor values (..., columns): an affine map plus a network.

    A camera sees positions through a nearly affine map, and feature points keep it so.  Starting with the affine part
    alone (`straight`) rules out curved coordinates in which another motion would satisfy the equations, such as an
    angle in the place of a position.
    """

    def __init__(self, chart: int, columns: int, config: NetworkConfig) -> None:
        super().__init__()
        self.affine = nn.Linear(chart, columns)
        self.net = nn.Sequential(
            nn.Linear(chart, config.decoder), nn.ELU(), nn.Linear(config.decoder, config.decoder), nn.ELU(),
            nn.Linear(config.decoder, columns),
        )  # fmt: skip

    def forward(self, chart: Tensor, straight: bool = False) -> Tensor:
        """(..., C) -> (..., columns)."""
        return self.affine(chart) if straight else self.affine(chart) + self.net(chart)
