"""The baseline's dynamics: context-aware model (Lee et al. 2020) - a context vector, then the next state."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.task import Task

HISTORY = 10  # samples that the context sees, as in the original
CONTEXT = 10  # its size, as in the original


class Context(nn.Module):
    """The window's first samples in ten numbers, and inputs in units of their size."""

    drive: Tensor

    def __init__(self, task: Task, config: NetworkConfig, drive: Tensor | None) -> None:
        super().__init__()
        self.task = task
        self.register_buffer("drive", torch.ones(task.inputs) if drive is None else drive.float())
        columns = HISTORY * (task.chart_width() + task.inputs)
        self.summarise = nn.Sequential(
            nn.Linear(columns, config.decoder), nn.SiLU(), nn.Linear(config.decoder, 64), nn.SiLU(),
            nn.Linear(64, CONTEXT),
        )  # fmt: skip

    def scaled(self, inputs: Tensor) -> Tensor:
        """Inputs (..., I) in units of their size, float32."""
        return inputs.float() / self.drive

    def describe(self, states: Tensor, inputs: Tensor) -> Tensor:
        """The window's first states (B, T, N) and inputs (B, T, I) -> context (B, 10)."""
        seen = torch.cat([self.task.to_chart(states[:, :HISTORY]), self.scaled(inputs[:, :HISTORY])], dim=-1)
        return self.summarise(seen.flatten(1))


class ContextDynamics(Context):
    """next = state + net(state, input, context), in the networks' units; no physics, no Fourier features."""

    scale: Tensor

    def __init__(self, task: Task, config: NetworkConfig, drive: Tensor | None = None) -> None:
        super().__init__(task, config, drive)
        width = config.decoder
        last = nn.Linear(width, len(task.states))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.change = nn.Sequential(
            nn.Linear(task.chart_width() + task.inputs + CONTEXT, width), nn.SiLU(), nn.Linear(width, width),
            nn.SiLU(), last,
        )  # fmt: skip
        self.register_buffer("scale", torch.tensor(task.state_scale))

    def forward(self, start: Tensor, context: Tensor, inputs: Tensor) -> Tensor:
        """Roll out from start (B S, N) with one context per window (B, 10) -> (B S, T, N)."""
        context = context.repeat_interleave(len(start) // len(context), dim=0)
        inputs = self.scaled(inputs)
        path, state = [start], start
        for step in range(inputs.shape[1] - 1):
            known = torch.cat([self.task.to_chart(state), inputs[:, step], context], dim=-1)
            state = state + 0.1 * self.scale * self.change(known)
            path.append(state)
        return torch.stack(path, dim=1)
