"""The general path: any right-hand side through torchdiffeq, adjoint included.

Non-linear laws and the paper's other systems use it; for the linear vehicle `model.simulate.linear` is exact and
much faster, and the tests hold the two against each other.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torchdiffeq import odeint, odeint_adjoint

from sprung.model.simulate.linear import LinearSimulator

Rate = Callable[[Tensor, Tensor], Tensor]  # (time, state) -> d state / dt


def solve(
    rate: Rate | torch.nn.Module,
    x0: Tensor,
    time: Tensor,
    *,
    method: str = "dopri5",
    rtol: float = 1e-9,
    atol: float = 1e-12,
    adjoint: bool = False,
    options: dict[str, object] | None = None,
) -> Tensor:
    """States (T, ...) at the given times (T,), the first of them x0.

    With `adjoint` gradients come from the adjoint equation at constant memory (Chen et al. 2018); `rate` must then
    be a module that owns its parameters.
    """
    if adjoint:
        if not isinstance(rate, torch.nn.Module):
            raise TypeError("adjoint gradients need a torch module that owns the parameters")
        adjoined: Tensor = odeint_adjoint(rate, x0, time, rtol=rtol, atol=atol, method=method, options=options)
        return adjoined
    found: Tensor = odeint(rate, x0, time, rtol=rtol, atol=atol, method=method, options=options)
    return found


class HermiteDrive(torch.nn.Module):
    """Drives and their rates at any time, from knots (B, T, W) a step `dt` apart; constant tensors, no gradient."""

    def __init__(self, knots: Tensor, dt: float) -> None:
        super().__init__()
        self.knots, self.dt = knots, dt

    def forward(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Values and rates at a scalar time, each (B, W/2)."""
        last = self.knots.shape[1] - 2
        k = int(torch.clamp(torch.floor(time.detach() / self.dt), 0, last))
        s = time / self.dt - k
        p0, m0 = self.knots[:, k, 0::2], self.knots[:, k, 1::2] * self.dt
        p1, m1 = self.knots[:, k + 1, 0::2], self.knots[:, k + 1, 1::2] * self.dt
        a2, a3 = 3 * (p1 - p0) - 2 * m0 - m1, 2 * (p0 - p1) + m0 + m1
        value = p0 + s * (m0 + s * (a2 + s * a3))
        return value, (m0 + s * (2 * a2 + 3 * s * a3)) / self.dt


class LinearRate(torch.nn.Module):
    """x' = A(theta) x + b p(t) + b' p'(t) of a system, with the log-ratios as a module parameter (B, P)."""

    def __init__(self, simulator: LinearSimulator, log_ratio: Tensor, knots: Tensor) -> None:
        super().__init__()
        self.simulator = simulator
        self.log_ratio = torch.nn.Parameter(log_ratio)
        self.drive = HermiteDrive(knots, simulator.dt)

    def forward(self, time: Tensor, x: Tensor) -> Tensor:
        A, b_value, b_rate = self.simulator.continuous(self.simulator.element_values(self.log_ratio))
        value, rate = self.drive(time)
        found: Tensor = (A @ x[:, :, None] + b_value @ value[:, :, None] + b_rate @ rate[:, :, None]).squeeze(2)
        return found
