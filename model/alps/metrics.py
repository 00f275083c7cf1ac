"""State, observation and parameter errors as the paper defines them, and relative ones.

SE = mean over windows of sum over samples of |simulated - true|^2, angles wrapped to half a turn
OE = mean over windows of sum over samples and pixels of |decoded - observed|^2
PE = mean over windows of |estimated - true|_1
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from sprung.model.alps.task import Task


def state_error(task: Task, simulated: Tensor, true: Tensor) -> float:
    """SE of states (B, T, N), in the units of the states."""
    return float(task.difference(simulated, true).square().sum((1, 2)).mean())


def relative_state_error(task: Task, simulated: Tensor, true: Tensor) -> float:
    """rms of the error over rms of the truth's variation, each state in units of its scale."""
    scale = true.new_tensor(task.state_scale)
    error = (task.difference(simulated, true) / scale).square().mean()
    spread = (task.difference(true, true.mean((0, 1), keepdim=True)) / scale).square().mean()
    return float((error / spread).sqrt())


def parameter_error(estimated: Tensor, true: Tensor) -> float:
    """PE of parameters (B, P)."""
    return float((estimated - true).abs().sum(-1).mean())


def relative_parameter_error(estimated: Tensor, true: Tensor) -> float:
    """Mean of |estimated - true| / true over windows and parameters."""
    return float(((estimated - true).abs() / true.abs()).mean())


def aligned(task: Task, encoded: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """Map from a model's states to the true ones, by the symmetries that nothing observable breaks.

    Fitted once per model on training windows (B, T, N), used for figures only, for every method alike.
    """
    return task.align(encoded.double(), true)
