"""Learned dynamics with an energy: positions and rates move as a Hamiltonian says, less friction, plus inputs.

    q' = dH/dp,   p' = -dH/dq - D dH/dp + G u,        D >= 0

The Hamiltonian is a network (Greydanus et al. 2019; on pictures, Toth et al. 2020), friction and inputs enter as in
Zhong, Dey, Chakraborty 2020.  It knows that there is an energy, and none of the equations of the system.  It sees the
context of `context.py`, since parameters differ between trajectories.  H has one hidden layer of softplus units, so
that its gradient is written down rather than traced: W' (v sigmoid(W x + b)).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.context import CONTEXT, Context
from sprung.model.alps.task import Task

_INNER = 2  # symplectic Euler steps per sample


class HamiltonianDynamics(Context):
    """Semi-implicit Euler steps of the equations above, in the networks' units and per sample."""

    scale: Tensor

    def __init__(self, task: Task, config: NetworkConfig, drive: Tensor | None = None) -> None:
        super().__init__(task, config, drive)
        self.rates = tuple(rate for rate, _ in task.velocity_of)
        self.places = tuple(place for _, place in task.velocity_of)
        pairs, columns = len(self.rates), len(self.rates) + sum(place in task.angles for place in self.places)
        self.hidden = nn.Linear(columns + pairs + CONTEXT, config.decoder)
        self.weight = nn.Parameter(torch.zeros(config.decoder))
        self.mass = nn.Parameter(torch.full((pairs,), -2.0))  # a kinetic energy from the start: q' = exp(mass) p
        self.friction = nn.Parameter(torch.full((pairs,), -4.0))
        self.entry = nn.Linear(task.inputs, pairs, bias=False) if task.inputs else None
        self.register_buffer("scale", torch.tensor(task.state_scale))

    def gradient(self, place: Tensor, rate: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """(dH/dq, dH/dp) at q, p, both (B, pairs), angles in rad, the rest in units of its size."""
        angles = [place_index in self.task.angles for place_index in self.places]
        columns, slopes = [], []  # what the network sees of q, and its derivative by q
        for index, angle in enumerate(angles):
            q = place[:, index]
            columns += [torch.cos(q), torch.sin(q)] if angle else [q]
            slopes += [(index, -torch.sin(q)), (index, torch.cos(q))] if angle else [(index, torch.ones_like(q))]
        x = torch.cat([torch.stack(columns, -1), rate, context], dim=-1)
        by_x = (self.weight * torch.sigmoid(self.hidden(x))) @ self.hidden.weight
        by_place = torch.zeros_like(place)
        for column, (index, slope) in enumerate(slopes):
            here = torch.tensor([index], device=place.device)
            by_place = by_place.index_add(1, here, (by_x[:, column] * slope)[:, None])
        return by_place, by_x[:, len(columns) : len(columns) + rate.shape[1]] + torch.exp(self.mass) * rate

    def forward(self, start: Tensor, context: Tensor, inputs: Tensor) -> Tensor:
        """Roll out from start (B S, N) with one context per window (B, 10) -> (B S, T, N)."""
        context = context.repeat_interleave(len(start) // len(context), dim=0)
        inputs = self.scaled(inputs)
        turns = torch.tensor([i in self.task.angles for i in range(len(self.scale))], device=start.device)
        size = torch.where(turns, 1.0, self.scale)
        place, rate = (start / size)[:, self.places], (start / size)[:, self.rates]
        damping = torch.exp(self.friction)
        path = [torch.cat([place, rate], dim=-1)]
        for step in range(inputs.shape[1] - 1):
            push = self.entry(inputs[:, step]) if self.entry is not None else 0.0
            for _ in range(_INNER):
                by_place, by_rate = self.gradient(place, rate, context)
                rate = rate + (push - by_place - damping * by_rate) / _INNER
                place = place + self.gradient(place, rate, context)[1] / _INNER
            path.append(torch.cat([place, rate], dim=-1))
        order = np.argsort([*self.places, *self.rates]).tolist()
        return torch.stack(path, dim=1)[..., order] * size
