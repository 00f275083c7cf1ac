"""`sprung bench physics-overhead`: what the physics in the loop costs one training update.

For each of the paper's four systems: the autoencoder, ALPS with torchdiffeq, and ALPS with the project's own
solution (exact where the system is linear, Runge-Kutta with its own adjoint where not): the same observations, the same
batch of windows, the same number of updates, taken in turn so that other load hits all alike.  Convolutions and
deconvolutions of the visual systems are in the loop, as in the paper's own figure (batch of 10: 498 s against 317 s,
57 % more); the train goes from its accelerometers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sprung.model.alps import mass_spring_damper, pendulum, train_fit, two_body
from sprung.model.alps.config import NetworkConfig, training_config
from sprung.model.alps.fit import VisualModel
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.losses import loss_of, picture_loss
from sprung.model.alps.network import Network
from sprung.model.alps.task import WINDOW, Task
from sprung.model.alps.train_fit import SensorAutoencoder
from sprung.model.alps.train_system import TrainData, generate, train_task
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.simulate.ode import HermiteDrive, solve
from sprung.service.errors import UserError

BATCH = 10  # windows, the paper's
REPEATS = {"quick": 3, "full": 30}
TARGET = 0.05  # of the linear system, whose solution is exact
SYSTEMS = ("mass_spring_damper", "pendulum", "two_body", "train")
_SOLVERS = ("torchdiffeq_dopri5", "torchdiffeq_rk4", "ours")

Update = Callable[[], Tensor]  # the loss of one update, with its graph


def run(
    budget: str = "quick", *, system: str | None = None, device: str = "cpu", batch: int = BATCH
) -> Iterator[dict[str, Any]]:
    """One dict per system and method: seconds per update (median), share over the autoencoder, the paper's share.

    system: one of `SYSTEMS`, all by default.
    """
    if budget not in REPEATS:
        raise UserError(f"bench physics-overhead: no budget {budget!r}; known are {', '.join(REPEATS)}")
    if system is not None and system not in SYSTEMS:
        raise UserError(f"bench physics-overhead: no system {system!r}; known are {', '.join(SYSTEMS)}")
    if device != "cpu" and not torch.cuda.is_available():
        raise UserError(f"bench physics-overhead: no device {device!r} here; leave --device out for the CPU")
    for name in [system] if system else SYSTEMS:
        if name == "train" and device != "cpu":
            continue  # its simulator is the product's, which runs on the CPU
        methods = _train_methods(batch) if name == "train" else _visual_methods(name, batch, device)
        for row in _rows(methods, REPEATS[budget], device):
            yield {"system": name, **row, "batch": batch, "repeats": REPEATS[budget], "device": device}


def _rows(methods: dict[str, tuple[nn.Module, Update]], repeats: int, device: str) -> Iterator[dict[str, Any]]:
    optimisers = {name: torch.optim.Adam(model.parameters(), 1e-4) for name, (model, _) in methods.items()}
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for repeat in range(repeats + 1):
        for name, (_, loss) in methods.items():
            taken = _timed(optimisers[name], loss, device)
            if repeat:  # the first is a warm-up
                seconds[name].append(taken)
    for name, times in seconds.items():
        wall, processor = np.median(np.array(times) / np.array(seconds["autoencoder"]), axis=0) - 1
        yield {
            "method": name,
            "seconds_per_update": round(float(np.median(times, axis=0)[0]), 4),
            "over_autoencoder": round(float(wall), 4),
            "processor_time_over_autoencoder": round(float(processor), 4),
            "paper_over_autoencoder": 0.57 if "torchdiffeq" in name else None,
            "target": TARGET if name == "alps_ours" else None,
        }


def _timed(optimiser: torch.optim.Optimizer, loss: Update, device: str) -> tuple[float, float]:
    """One update end to end; seconds on the clock and of the processor (the latter hardly see other load)."""
    begin, busy = time.perf_counter(), time.process_time()
    optimiser.zero_grad()
    loss().backward()
    optimiser.step()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - begin, time.process_time() - busy


def _visual_methods(name: str, batch: int, device: str) -> dict[str, tuple[nn.Module, Update]]:
    task: Task = {"mass_spring_damper": mass_spring_damper, "pendulum": pendulum, "two_body": two_body}[name].TASK
    rollouts = task.sample(batch, np.random.default_rng(0), task.seen)
    assert task.render is not None
    pictures = task.render(rollouts.states[:, :WINDOW].flatten(0, 1)).to(device)
    inputs = rollouts.inputs[:, :WINDOW].to(device)
    methods = {"autoencoder": _model(task, "autoencoder", device)}
    for solver in _SOLVERS:
        solved = task if solver == "ours" else stepwise(task, solver.removeprefix("torchdiffeq_"))
        methods[f"alps_{solver}"] = _model(solved, "alps", device)
    return {method: (model, _visual_loss(model, pictures, inputs, batch)) for method, model in methods.items()}


def stepwise(task: Task, method: str) -> Task:
    """A visual task with torchdiffeq in place of the project's solution; inputs held between samples, as in the truth.

    Held inputs jump at samples: the adaptive solver is told so, the fixed-step one looks just inside each interval.
    """

    def simulate(start: Tensor, parameters: Tensor, inputs: Tensor) -> Tensor:
        times = torch.arange(inputs.shape[1], dtype=start.dtype, device=start.device) * task.step
        options: dict[str, object] = {}
        if task.name == "mass_spring_damper":
            rate = _held_rate(parameters, inputs, times)
            options = {"jump_t": times[1:-1]} if method == "dopri5" else {"perturb": True}
        elif task.name == "pendulum":

            def rate(time: Tensor, x: Tensor) -> Tensor:
                return pendulum.derivative(x, parameters)
        else:
            start = two_body.with_energy(start, parameters)

            def rate(time: Tensor, x: Tensor) -> Tensor:
                return two_body.derivative(x)

        return solve(rate, start, times, method=method, rtol=1e-6, atol=1e-9, options=options).transpose(0, 1)

    return replace(task, simulate=simulate)


def _held_rate(stiffness: Tensor, inputs: Tensor, times: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    a, b = mass_spring_damper.matrices(stiffness)
    drive = inputs @ b.mT  # (B, T, N)

    def rate(time: Tensor, x: Tensor) -> Tensor:
        at = int(torch.searchsorted(times, time, right=True)) - 1
        return (a @ x[..., None])[..., 0] + drive[:, min(max(at, 0), len(times) - 1)]

    return rate


def _visual_loss(model: VisualModel, pictures: Tensor, inputs: Tensor, batch: int) -> Update:
    """The whole loss of pictures, convolutions included."""
    task = model.network.task
    config = training_config(task.name, "full", 0)

    def loss() -> Tensor:
        embeddings = model.frames.encode(pictures).unflatten(0, (batch, WINDOW))
        passed = model.network(embeddings, inputs)
        assert passed.observed is not None
        parts = loss_of(task, passed, embeddings, config, 1e-3)
        return parts.total + picture_loss(model.frames.decode(passed.observed.flatten(0, 1)), pictures)

    return loss


class _TrainAutoencoder(SensorAutoencoder):
    """The train from its accelerometers with a chosen solver, or with none: what is encoded is decoded."""

    def __init__(self, data: TrainData, solver: str | None) -> None:
        super().__init__(train_task(data, data.expected_size()), data, known=False)
        self.solver = solver

    def follow(self, log_ratio: Tensor, knots: Tensor, states: Tensor) -> tuple[Tensor | None, Tensor]:
        if self.solver is None:
            return None, states.double()
        if self.solver == "ours":
            return super().follow(log_ratio, knots, states)
        return None, _stepped(self.simulator, log_ratio, knots, states[:, 0].double(), self.solver)


def _stepped(simulator: LinearSimulator, log_ratio: Tensor, knots: Tensor, start: Tensor, method: str) -> Tensor:
    """The train's states by torchdiffeq (B, T, 18)."""
    a, by_value, by_rate = simulator.continuous(simulator.element_values(log_ratio))
    drive = HermiteDrive(knots, simulator.dt)

    def rate(time: Tensor, x: Tensor) -> Tensor:
        value, slope = drive(time)
        found: Tensor = (a @ x[:, :, None] + by_value @ value[:, :, None] + by_rate @ slope[:, :, None]).squeeze(2)
        return found

    times = torch.arange(knots.shape[1], dtype=start.dtype) * simulator.dt
    return solve(rate, start, times, method=method, rtol=1e-6, atol=1e-9).transpose(0, 1)


def _train_methods(batch: int) -> dict[str, tuple[nn.Module, Update]]:
    data = generate(True, np.random.default_rng(0), batch)
    methods: dict[str, tuple[nn.Module, Update]] = {}
    for name, solver in (("autoencoder", None), *((f"alps_{s}", s.removeprefix("torchdiffeq_")) for s in _SOLVERS)):
        torch.manual_seed(0)
        model = _TrainAutoencoder(data, solver)
        methods[name] = (model, _train_loss(model, data))
    return methods


def _train_loss(model: SensorAutoencoder, data: TrainData) -> Update:
    def loss() -> Tensor:
        rows = torch.arange(len(data.states))
        return train_fit.loss_of(model, data, rows, torch.zeros_like(rows), train_fit.TrainConfig(), 10**9)

    return loss


def _model(task: Task, method: str, device: str) -> VisualModel:
    torch.manual_seed(0)
    sizes = NetworkConfig()
    return VisualModel(FrameAutoencoder(sizes), Network(task, method, sizes)).to(device)
