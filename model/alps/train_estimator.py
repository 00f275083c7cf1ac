"""The train task's estimator: features of a window to 24 log-ratios of parameters to their nominal values."""

from __future__ import annotations

import torch
from torch import Tensor, nn

WIDTHS = (256, 128)
BOUND = 1.2  # of a log-ratio: a third to three times nominal; keeps the simulator away from absurd values


class LogRatioEstimator(nn.Module):
    """Features (B, columns) -> log(theta / nominal) (B, P); nominal at the start of training."""

    def __init__(self, columns: int, parameters: int, widths: tuple[int, int] = WIDTHS) -> None:
        super().__init__()
        first, second = widths
        last = nn.Linear(second, parameters)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(nn.Linear(columns, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), last)

    def forward(self, features: Tensor) -> Tensor:
        """(B, columns) -> (B, P)."""
        return BOUND * torch.tanh(self.net(features) / BOUND)
