"""`sprung bench physics-overhead`: what the physics in the loop costs one training update.

Autoencoder, ALPS with a step-by-step solver (torchdiffeq) and ALPS with the exact batched solution: the same
pictures, the same batch of windows, the same machine, updates taken in turn so that other load hits all alike.  The
system is the double mass-spring-damper, convolutions and deconvolutions included, as in the paper's own figure
(batch of 10: 498 s against 317 s, 57 % more).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sprung.model.alps import mass_spring_damper
from sprung.model.alps.config import NetworkConfig, training_config
from sprung.model.alps.fit import VisualModel
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.losses import loss_of, picture_loss
from sprung.model.alps.network import Network
from sprung.model.alps.task import WINDOW, Task
from sprung.model.simulate.ode import solve
from sprung.service.errors import UserError

BATCH = 10  # windows, the paper's
REPEATS = {"quick": 3, "full": 30}
TARGET = 0.05


def run(budget: str = "quick", *, device: str = "cpu", batch: int = BATCH) -> Iterator[dict[str, Any]]:
    """One dict per method: seconds per update (median), share over the autoencoder, the paper's share."""
    if budget not in REPEATS:
        raise UserError(f"bench physics-overhead: no budget {budget!r}; known are {', '.join(REPEATS)}")
    if device != "cpu" and not torch.cuda.is_available():
        raise UserError(f"bench physics-overhead: no device {device!r} here; leave --device out for the CPU")
    task = mass_spring_damper.TASK
    rollouts = task.sample(batch, np.random.default_rng(0), task.seen)
    assert task.render is not None
    pictures = task.render(rollouts.states[:, :WINDOW].flatten(0, 1)).to(device)
    inputs = rollouts.inputs[:, :WINDOW].to(device)
    methods = {
        "autoencoder": _model(task, "autoencoder", device),
        "alps_torchdiffeq_dopri5": _model(_stepwise("dopri5"), "alps", device),
        "alps_torchdiffeq_rk4": _model(_stepwise("rk4"), "alps", device),
        "alps_exact": _model(task, "alps", device),
    }
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for repeat in range(REPEATS[budget] + 1):
        for name, (model, optimiser) in methods.items():
            taken = _update(model, optimiser, pictures, inputs, batch)
            if repeat:  # the first is a warm-up
                seconds[name].append(taken)
    for name, times in seconds.items():
        wall, processor = np.median(np.array(times) / np.array(seconds["autoencoder"]), axis=0) - 1
        yield {
            "method": name,
            "seconds_per_update": round(float(np.median(times, axis=0)[0]), 4),
            "over_autoencoder": round(float(wall), 4),
            "processor_time_over_autoencoder": round(float(processor), 4),
            "paper_over_autoencoder": 0.57 if name.startswith("alps_torchdiffeq") else None,
            "target": TARGET if name == "alps_exact" else None,
            "batch": batch,
            "repeats": REPEATS[budget],
            "device": device,
        }


def _stepwise(method: str) -> Task:
    """The task with torchdiffeq in place of the exact solution; inputs held between samples, as in the truth.

    Held inputs jump at samples: the adaptive solver is told so, the fixed-step one looks just inside each interval.
    """
    task = mass_spring_damper.TASK

    def simulate(start: Tensor, stiffness: Tensor, inputs: Tensor) -> Tensor:
        a, b = mass_spring_damper.matrices(stiffness)
        times = torch.arange(inputs.shape[1], dtype=start.dtype, device=start.device) * task.step
        drive = inputs @ b.mT  # (B, T, N)

        def rate(time: Tensor, x: Tensor) -> Tensor:
            at = int(torch.searchsorted(times, time, right=True)) - 1
            return (a @ x[..., None])[..., 0] + drive[:, min(max(at, 0), len(times) - 1)]

        options: dict[str, object] = {"jump_t": times[1:-1]} if method == "dopri5" else {"perturb": True}
        return solve(rate, start, times, method=method, rtol=1e-6, atol=1e-9, options=options).transpose(0, 1)

    return replace(task, simulate=simulate)


def _model(task: Task, method: str, device: str) -> tuple[VisualModel, torch.optim.Optimizer]:
    torch.manual_seed(0)
    sizes = NetworkConfig()
    model = VisualModel(FrameAutoencoder(sizes), Network(task, method, sizes)).to(device)
    return model, torch.optim.Adam(model.parameters(), 1e-4)


def _update(
    model: nn.Module, optimiser: torch.optim.Optimizer, pictures: Tensor, inputs: Tensor, batch: int
) -> tuple[float, float]:
    """One update end to end; seconds on the clock and of the processor (the latter hardly see other load)."""
    assert isinstance(model, VisualModel)
    begin, busy = time.perf_counter(), time.process_time()
    embeddings = model.frames.encode(pictures).unflatten(0, (batch, WINDOW))
    passed = model.network(embeddings, inputs)
    task = model.network.task
    loss = loss_of(task, passed, embeddings, training_config(task.name, "full", 0), 1e-3).total
    loss = loss + picture_loss(model.frames.decode(passed.observed.flatten(0, 1)), pictures)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if pictures.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - begin, time.process_time() - busy
