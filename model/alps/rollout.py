"""Fixed-step solutions on the sample grid for the two non-linear systems of the paper.

The classical Runge-Kutta step of order four at one step per sample: its error stays below 1e-4 of the states here
(asserted in `tests/test_alps_tasks.py`), and unlike an adaptive solver it costs the same for every batch, which is
what a training loop wants.  Linear systems with held inputs use their exact solution.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def runge_kutta(derivative: Callable[[Tensor], Tensor], start: Tensor, samples: int, step: float) -> Tensor:
    """Solve x' = derivative(x) from `start` (B, N) -> (B, samples, N), the first sample being `start`."""
    path = [start]
    state = start
    for _ in range(samples - 1):
        k1 = derivative(state)
        k2 = derivative(state + 0.5 * step * k1)
        k3 = derivative(state + 0.5 * step * k2)
        k4 = derivative(state + step * k3)
        state = state + (step / 6) * (k1 + 2 * k2 + 2 * k3 + k4)
        path.append(state)
    return torch.stack(path, dim=1)


def held(a: Tensor, b: Tensor, start: Tensor, inputs: Tensor, step: float) -> Tensor:
    """Exact x' = A x + B u for inputs held between samples: A (B, N, N), B (B, N, I), inputs (B, T, I) -> (B, T, N).

    One matrix exponential of [[A, B], [0, 0]] gives the transition F and the step's drive; the recursion
    x[k+1] = F x[k] + w[k] is then summed in log2(T) rounds (powers F, F^2, F^4, ...: a parallel prefix sum) instead
    of T steps, so that a training step pays for seven small matrix products.
    """
    size, width = a.shape[-1], b.shape[-1]
    block = torch.zeros(len(a), size + width, size + width, dtype=a.dtype, device=a.device)
    block = torch.cat([torch.cat([a, b], dim=-1), block[:, size:]], dim=-2)
    transition = torch.matrix_exp(step * block)
    power = transition[:, :size, :size].mT
    drive = inputs[:, :-1] @ transition[:, :size, size:].mT
    path = torch.cat([start[:, None], drive], dim=1)
    reach = 1
    while reach < path.shape[1]:
        path = torch.cat([path[:, :reach], path[:, reach:] + path[:, :-reach] @ power], dim=1)
        power = power @ power
        reach *= 2
    return path
