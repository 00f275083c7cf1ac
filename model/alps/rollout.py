"""Fixed-step solutions on the sample grid for the two non-linear systems of the paper.

The classical Runge-Kutta step of order four at one step per sample: its error stays below 1e-4 of the states here
(asserted in `tests/alps/test_tasks.py`), and unlike an adaptive solver it costs the same for every batch, which is
what a training loop wants.  Linear systems with held inputs use their exact solution.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Derivative = Callable[..., Tensor]  # (state (..., N), *parameters (..., P)) -> (..., N)


def runge_kutta(derivative: Derivative, start: Tensor, samples: int, step: float, *parameters: Tensor) -> Tensor:
    """Solve x' = derivative(x, *parameters) from `start` (B, N) -> (B, samples, N), the first sample being `start`.

    Differentiable in `start` and `parameters` (B, P).
    """
    path: Tensor = _Path.apply(derivative, samples, step, start, *parameters)  # type: ignore[no-untyped-call]  # torch's `apply`
    return path


class _Path(torch.autograd.Function):
    """Steps forward without a graph; backward, the Jacobians of all steps at once and then the adjoint recursion.

    lambda[k] = dL/dx[k] + J[k]' lambda[k+1]: the same gradient as through every operation of every step, several
    times faster, since the many small operations along the path leave the graph.
    """

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]  # of torch's
        ctx, derivative: Derivative, samples: int, step: float, start: Tensor, *parameters: Tensor
    ) -> Tensor:
        states = [start]
        for _ in range(samples - 1):
            states.append(_step(derivative, states[-1], step, *parameters))
        path = torch.stack(states, dim=1)
        ctx.derivative, ctx.step = derivative, step
        ctx.save_for_backward(path, *parameters)
        return path

    @staticmethod
    def backward(ctx, grad: Tensor):  # type: ignore[no-untyped-def]  # of torch's
        path, *parameters = ctx.saved_tensors
        with torch.enable_grad():
            before = path[:, :-1].detach().requires_grad_()  # (B, T - 1, N)
            leaves = [value.detach().requires_grad_() for value in parameters]
            after = _step(ctx.derivative, before, ctx.step, *[leaf[:, None] for leaf in leaves])
            columns = after.sum((0, 1)).unbind()
        rows = [torch.autograd.grad(column, before, retain_graph=True)[0] for column in columns]
        transposed = torch.stack(rows, dim=-1)  # J', (B, T - 1, N, N)
        adjoint = [grad[:, -1, :, None]]
        for jacobian, here in zip(transposed.unbind(1)[::-1], grad[..., None].unbind(1)[-2::-1], strict=True):
            adjoint.append(torch.baddbmm(here, jacobian, adjoint[-1]))
        adjoints = torch.stack(adjoint[::-1], dim=1)[..., 0]  # (B, T, N)
        slopes = torch.autograd.grad(after, leaves, adjoints[:, 1:]) if leaves else ()
        return None, None, None, adjoints[:, 0], *slopes


def _step(derivative: Derivative, state: Tensor, step: float, *parameters: Tensor) -> Tensor:
    k1 = derivative(state, *parameters)
    k2 = derivative(state + 0.5 * step * k1, *parameters)
    k3 = derivative(state + 0.5 * step * k2, *parameters)
    k4 = derivative(state + step * k3, *parameters)
    return state + (step / 6) * (k1 + 2 * k2 + 2 * k3 + k4)


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
