"""Data of Gauss-Newton on windows: the windows, their frequency responses, and the normal equations."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor

from sprung.model.signals import BoolArray


@dataclass(frozen=True, slots=True)
class WindowBatch:
    """Windows with the same sensors present, as the model needs them."""

    w: Tensor  # knots of the drives, shape (B, T, W)
    measured: Tensor  # sensors present, shape (B, T, S')
    present: BoolArray  # which sensors these are, shape (S,)
    inputs: Tensor  # as measured, shape (B, T, I)

    def take(self, at: Tensor) -> WindowBatch:
        if len(at) == len(self.w):
            return self
        return WindowBatch(self.w[at], self.measured[at], self.present, self.inputs[at])


@dataclass(frozen=True, slots=True)
class Transfer:
    """Compressed signals (R of them) over frequency, before whitening."""

    compliance: Tensor  # displacement per generalised force, shape (B, F, n, n)
    per_load: Tensor  # per generalised force, shape (B, F, R, n)
    per_force: Tensor  # per element force, shape (B, F, R, E)
    drive: Tensor  # per unit of every drive that follows its own slope, shape (B, F, R, W/2)


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Gauss-Newton's view of a batch at one point: whitened columns and their products."""

    whiten: Tensor  # shape (B, F, R, R), weights of the bins included
    transfer: Transfer
    free: Tensor  # whitened free responses and trends, normalised, shape (B, N', K)
    free_scale: Tensor  # what they were divided by, shape (B, N')
    sensitivities: Tensor  # whitened, shape (B, P, K)
    factor: Tensor  # Cholesky factor of the free responses' products, shape (B, N', N')
    across: Tensor  # free responses solved for the sensitivities, shape (B, N', P)
    covariance: Tensor  # of the log-ratios, weak prior included, shape (B, P, P)
    holding: Tensor  # Cholesky factor of their information while they are held about nominal, shape (B, P, P)
    x: Tensor  # log-ratios of this point, shape (B, P)
    x0: Tensor  # best initial state here, shape (B, N)
    cost: Tensor  # weighted squares with that state, shape (B,)
    gradient: Tensor  # minus half the gradient of the cost, shape (B, P)
    step: Tensor  # to the minimum of the linearised cost, held about nominal, shape (B, P)

    def take(self, at: Tensor) -> Linearisation:
        """The windows `at` of the batch."""
        return self if len(at) == len(self.x) else _taken(self, at)

    def state_after(self, step: Tensor) -> Tensor:
        """Best initial state when the log-ratios move by `step`."""
        moved = (self.across @ step.unsqueeze(2)).squeeze(2) / self.free_scale
        return self.x0 - moved[:, : self.x0.shape[1]]


@dataclass(frozen=True, slots=True)
class Chord:
    """A second step of Gauss-Newton with the products of the first."""

    cost: Tensor  # weighted squares before the step, shape (B,)
    step: Tensor  # held about nominal, shape (B, P)
    released: Tensor  # the same under the weak prior alone: to what the window says, shape (B, P)
    x0: Tensor  # best initial state after it, shape (B, N)
    error: Tensor  # rms of measured minus simulated before it, shape (B, S')
    residual: Tensor  # whitened, before it, shape (B, K, 1)
    outputs: Tensor  # simulated, before it, shape (B, T, S')
    states: Tensor  # shape (B, T, N)

    def take(self, at: Tensor) -> Chord:
        """The windows `at` of the batch."""
        return self if len(at) == len(self.cost) else _taken(self, at)


def _taken(batch: Any, at: Tensor) -> Any:
    """A dataclass of tensors (B, ...), nested ones included, with only the windows `at`."""
    parts = {f.name: getattr(batch, f.name) for f in fields(batch)}
    return replace(batch, **{n: p[at] if isinstance(p, Tensor) else _taken(p, at) for n, p in parts.items()})
