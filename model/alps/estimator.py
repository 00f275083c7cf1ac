"""From a window's states to the parameters: the paper's estimator f on |FFT|, and on raw states for its ablation.

The output is bounded: a sigmoid from half the lowest to one and a half times the highest value of the training
range, which leaves room for unseen values and keeps the simulator away from absurd ones early in training (the paper
too names a range of theta, (0, 10]).  Training starts at the middle of the range.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.task import WINDOW, Task
from sprung.model.identification.amortised.features import magnitudes

Features = Callable[[Tensor], Tensor]


def log_magnitudes(chart: Tensor) -> Tensor:
    """|DFT| of each column over the window, (B, T, C) -> (B, F C), as log(1 + |X|): magnitudes span decades."""
    return torch.log1p(magnitudes(chart))


def raw(chart: Tensor) -> Tensor:
    """The states as they are, (B, T, C) -> (B, T C)."""
    return chart.flatten(1)


class AlpsEstimator(nn.Module):
    """Feed-forward network on features of the encoded states -> parameters (B, P)."""

    low: Tensor
    span: Tensor
    middle: Tensor

    def __init__(self, task: Task, config: NetworkConfig, features: Features) -> None:
        super().__init__()
        self.task, self.features = task, features
        columns = features(torch.zeros(1, WINDOW, task.chart_width())).shape[1]
        first, second = config.estimator
        last = nn.Linear(second, len(task.parameters))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(
            nn.LayerNorm(columns), nn.Linear(columns, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(),
            last,
        )  # fmt: skip
        low, high = torch.tensor(task.seen.low), torch.tensor(task.seen.high)
        self.register_buffer("low", 0.5 * low)
        self.register_buffer("span", 1.5 * high - 0.5 * low)
        self.register_buffer("middle", torch.logit((0.5 * (low + high) - self.low) / self.span))

    def forward(self, states: Tensor) -> Tensor:
        """(B, T, N) -> (B, P)."""
        r = self.net(self.features(self.task.to_chart(states).float()))
        return self.low + self.span * torch.sigmoid(r + self.middle)

    def at_middle(self, count: int) -> Tensor:
        """The middle of the training range, (count, P)."""
        return (self.low + self.span * torch.sigmoid(self.middle)).expand(count, -1)
