"""From the embeddings of a window to posteriors over its states.

`AttentionEncoder` is the paper's: position signal, multi-head self-attention, feed-forward heads.
`DifferenceEncoder` is its ablation: an MLP finds positions frame by frame and first-order differences give the rates.
Both return means, spreads and one draw in the task's states; the posteriors live in units of `state_scale`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.embedding import positions
from sprung.model.alps.posterior import (
    MAX_CONCENTRATION,
    gaussian_divergence,
    gaussian_sample,
    von_mises_divergence,
    von_mises_sample,
)
from sprung.model.alps.task import WINDOW, Opening, Task


@dataclass(frozen=True)
class Encoded:
    """Posterior means, one reparameterised draw and the divergence of a window's states."""

    mean: Tensor  # (B, T, N)
    draw: Tensor  # (B, T, N)
    divergence: Tensor  # (B, T), nats, summed over the states


class PosteriorHead(nn.Module):
    """Features (..., W) -> posterior of chosen states: two numbers and log k for an angle, else mean and log std."""

    bent: Tensor  # (columns,): 0 where the embedding alone decides

    def __init__(self, task: Task, states: tuple[int, ...], width: int, embedding: int) -> None:
        super().__init__()
        self.opening = task.opening
        self.states, self.angles = states, set(task.angles)
        self.scales = [task.state_scale[index] for index in states]
        columns = sum(3 if index in self.angles else 2 for index in states)
        self.out = nn.Linear(width, columns)
        with torch.no_grad():
            self.out.weight *= 3  # states of about unit size from the start
        self.direct = nn.Linear(embedding, columns)
        nn.init.zeros_(self.direct.weight)
        nn.init.zeros_(self.direct.bias)
        self.register_buffer("bent", torch.ones(columns))
        self.resting = False  # straight positions stay as they are

    @torch.no_grad()
    def straighten(self, positions: tuple[int, ...]) -> None:
        """Read these positions (an angle's sine and cosine) off the embedding by an affine map, and by nothing else.

        A camera sees positions through an affine map, and feature points keep it so, to a hundredth of a pixel.  A
        network in between bends it: large orbits come out small, and the physics needs long to bend it back.
        """
        for index, columns in self._mean_columns().items():
            if index in positions:
                self.bent[columns] = 0
                nn.init.normal_(self.direct.weight[columns], std=self.direct.in_features**-0.5)

    @torch.no_grad()
    def open_with_components(self, embeddings: Tensor) -> None:
        """Start the means of the positions from two principal components of embeddings (M, E), where the task says how.

        Components span what the picture shows; `Task.opening` makes positions of them.
        """
        if self.opening is None:
            return
        weights, offsets = (value.float() for value in opened_positions(self.opening, embeddings))
        at = 0
        for columns in self._mean_columns().values():
            here = slice(at, at + columns.stop - columns.start)
            if here.stop > len(weights):
                break
            self.direct.weight[columns], self.direct.bias[columns] = weights[here], offsets[here]
            at = here.stop

    def _mean_columns(self) -> dict[int, slice]:
        """Columns of each state's mean in the output: sine and cosine of an angle, else one."""
        columns, at = {}, 0
        for index in self.states:
            width = 2 if index in self.angles else 1
            columns[index] = slice(at, at + width)
            at += width + 1
        return columns

    def forward(self, features: Tensor, embeddings: Tensor) -> Encoded:
        """(B, T, W) and (B, T, E) -> posterior of `states`, in their order."""
        straight = self.direct(embeddings)
        if self.resting:
            straight = torch.where(self.bent == 0, straight.detach(), straight)
        raw = self.bent * self.out(features) + straight
        means, draws, divergence, at = [], [], torch.zeros_like(raw[..., 0]), 0
        for index, scale in zip(self.states, self.scales, strict=True):
            if index in self.angles:
                angle = torch.atan2(raw[..., at], raw[..., at + 1])
                concentration = torch.exp((raw[..., at + 2] + 4).clamp(-4, 9)).clamp_max(MAX_CONCENTRATION)
                means.append(angle)
                draws.append(von_mises_sample(angle, concentration))
                divergence = divergence + von_mises_divergence(angle, concentration)
                at += 3
            else:
                mean, log_std = raw[..., at], (raw[..., at + 1] - 3).clamp(-7, 1)
                means.append(scale * mean)
                draws.append(scale * gaussian_sample(mean, log_std))
                divergence = divergence + gaussian_divergence(mean, log_std)
                at += 2
        return Encoded(torch.stack(means, -1), torch.stack(draws, -1), divergence)


class _Block(nn.Module):
    """Self-attention and a feed-forward network, both residual, normalised before."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.join = nn.Linear(width, width)
        self.forward_net = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, z: Tensor) -> Tensor:
        batch, length, width = z.shape
        qkv = self.query_key_value(self.before(z)).view(batch, length, 3, self.heads, width // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # each (B, heads, T, W / heads)
        seen = nn.functional.scaled_dot_product_attention(query, key, value)
        z = z + self.join(seen.transpose(1, 2).reshape(batch, length, width))
        return z + self.forward_net(self.between(z))


def opened_positions(opening: Opening, embeddings: Tensor) -> tuple[Tensor, Tensor]:
    """Affine map from embeddings (M, E) to the positions that a task's opening makes of their two principal components.

    Weights (P, E) and offsets (P,), float64.  By the covariance in double precision: single precision leaves digits
    that depend on where a tensor lies in memory.  The sign of a component, which is free, is that of its largest entry.
    """
    x = embeddings.double()
    mean = x.mean(0)
    variance, vectors = torch.linalg.eigh((x - mean).mT @ (x - mean) / len(x))
    directions = vectors[:, [-1, -2]].mT / variance[[-1, -2], None].sqrt()
    largest = directions.gather(1, directions.abs().argmax(1, keepdim=True))
    directions = directions * largest.sign()
    weights, offsets = opening((x - mean) @ directions.mT)
    return weights @ directions, offsets - weights @ directions @ mean


class AttentionEncoder(nn.Module):
    """Embeddings (B, T, E) -> posteriors of all states."""

    place: Tensor

    def __init__(self, task: Task, config: NetworkConfig) -> None:
        super().__init__()
        self.lift = nn.Linear(config.embedding, config.width)
        self.register_buffer("place", positions(WINDOW, config.width))
        self.blocks = nn.Sequential(*[_Block(config.width, config.heads) for _ in range(config.layers)])
        self.head = PosteriorHead(task, tuple(range(len(task.states))), config.width, config.embedding)

    def forward(self, embeddings: Tensor) -> Encoded:
        """(B, T, E) -> posteriors."""
        return self.head(self.blocks(self.lift(embeddings) + self.place), embeddings)


class DifferenceEncoder(nn.Module):
    """Embeddings (B, T, E) -> posteriors of positions frame by frame; rates by first-order differences."""

    def __init__(self, task: Task, config: NetworkConfig) -> None:
        super().__init__()
        self.task = task
        self.placed = task.placed
        width = 2 * config.width
        self.net = nn.Sequential(
            nn.Linear(config.embedding, width), nn.ELU(), nn.Linear(width, width), nn.ELU(),
            nn.Linear(width, width), nn.ELU(),
        )  # fmt: skip
        self.head = PosteriorHead(task, self.placed, width, config.embedding)

    def forward(self, embeddings: Tensor) -> Encoded:
        """(B, T, E) -> posteriors; the divergence counts positions only, rates follow from them."""
        found = self.head(self.net(embeddings), embeddings)
        return Encoded(self._with_rates(found.mean), self._with_rates(found.draw), found.divergence)

    def _with_rates(self, placed: Tensor) -> Tensor:
        """Positions (B, T, n) -> all states (B, T, N); the last rate repeats the one before."""
        columns: dict[int, Tensor] = {index: placed[..., i] for i, index in enumerate(self.placed)}
        for rate, place in self.task.velocity_of:
            step = columns[place].diff(dim=-1)
            if place in self.task.angles:
                step = torch.atan2(torch.sin(step), torch.cos(step))
            step = step * self.task.sample_rate
            columns[rate] = torch.cat([step, step[:, -1:]], dim=-1)
        return torch.stack([columns[index] for index in range(len(self.task.states))], dim=-1)
