"""Training of the estimator: simulated windows with known parameters, then recordings without any.

From simulated windows the loss is the Gaussian negative log-likelihood of the true log-ratios, which trains the
estimate and its predicted covariance together.  From recordings it is the paper's physics in the loop: the window is
simulated with the estimated parameters and the misfit of the outputs is the loss; no label is used.

Every step draws from a generator seeded by (seed, step), so a run that was interrupted and resumed ends in the same
weights as one that was not.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from sprung.model.identification.amortised.estimator import (
    Estimator,
    EstimatorNet,
    new_estimator,
    noise_power,
    save_estimator,
)
from sprung.model.identification.amortised.features import ForceBalance
from sprung.model.identification.excitation import ERRI_HIGH, ERRI_LOW, draw_log_ratios, simulate_runs
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.system import System

Progress = Callable[[str, int, int, float], None]  # stage, done, total, latest loss


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Everything that decides the weights, with the seed."""

    seed: int = 20260921
    records: int = 2000  # simulated records, each with its own vehicle, speed and track
    windows_per_record: int = 4
    spread: float = 0.5  # parameters are drawn within nominal (1 +- spread)
    speed: tuple[float, float] = (25.0, 60.0)  # m/s
    roughness: tuple[float, float] = (0.5 * ERRI_LOW, ERRI_HIGH)
    steps: int = 1500
    batch: int = 256
    learning_rate: float = 4e-3
    recording_steps: int = 200
    checkpoint_every: int = 100


@dataclass(frozen=True, slots=True)
class WindowCost:
    """Average cost of identifying a window."""

    iterations: float
    milliseconds: float  # of a core


def training_benefit(
    system: System, estimator: Estimator, windows: int = 48, seed: int = 1
) -> tuple[WindowCost, WindowCost]:
    """Cost of a window without and with the trained start, on simulated windows of vehicles within +-30 %."""
    rng = np.random.default_rng(seed)
    truth = draw_log_ratios(system, windows, 0.3, rng)
    values = simulate_runs(system, truth, system.window, rng).values
    refiner = Refiner(system)
    found = []
    starts: list[Callable[[], FloatArray | None]] = [lambda: None, lambda: estimator.estimate(values).log_ratio]
    for start in starts:
        refiner.refine(values[:4])  # workspaces are made with the first windows
        begin = time.process_time()
        refined = refiner.refine(values, start())
        spent = time.process_time() - begin
        found.append(WindowCost(float(refined.iterations.mean()), 1e3 * spent / windows))
    return found[0], found[1]


def train(
    system: System,
    out: str | Path,
    *,
    recordings: FloatArray | None = None,
    settings: TrainingSettings | None = None,
    progress: Progress | None = None,
) -> Estimator:
    """Train from simulation and, with windows (B, T, C) from recordings, further without labels; save to `out`.

    Errors: `ValueError` when the sensors of the system give no force balance.
    """
    settings = settings or TrainingSettings()
    report = progress or (lambda *_: None)
    begin = time.perf_counter()
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    features = ForceBalance(system, system.window)
    data = _simulated_rows(features, settings, report)
    net = new_estimator(system, settings.seed).double()
    _initialise(net, features, settings)
    run = TrainingRun(net, out / "checkpoint", settings, _fingerprint(system, settings))
    run.resume()
    _fit_simulated(run, settings, data, report)
    if recordings is not None and len(recordings):
        _fit_recordings(run, settings, features, recordings, report)
    measured = evaluate(system, Estimator(system, net), settings.seed + 1)
    manifest_settings = asdict(settings) | {"recording_windows": 0 if recordings is None else len(recordings)}
    measured["training_seconds"] = round(time.perf_counter() - begin, 1)
    save_estimator(out, system, net, manifest_settings, settings.seed, measured)
    run.forget()
    return Estimator(system, net)


def evaluate(system: System, estimator: Estimator, seed: int, windows: int = 1000) -> dict[str, object]:
    """Errors on fresh windows: rms per parameter and the share inside the predicted 95 % intervals."""
    rng = np.random.default_rng(seed)
    truth = draw_log_ratios(system, windows, 0.5, rng)
    output = estimator.estimate(simulate_runs(system, truth, system.window, rng).values)
    error = output.log_ratio - truth
    std = np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
    rms = np.sqrt((error**2).mean(axis=0))
    return {
        "windows": windows,
        "rms_log_ratio": {p.name: round(float(r), 5) for p, r in zip(system.parameters, rms, strict=True)},
        "mean_absolute_log_ratio": round(float(np.abs(error).mean()), 5),
        "coverage_95": round(float((np.abs(error) < 1.96 * std).mean()), 4),
    }


@dataclass(slots=True)
class _Rows:
    """Rows of clean windows and rows of noise alone: any sum of the two is a fresh noisy window."""

    clean: Tensor  # [regressors, target], float32, shape (windows, R, P + 1)
    noise: Tensor  # shape (draws, R, P + 1)
    log_ratio: Tensor  # shape (windows, P)


def _simulated_rows(features: ForceBalance, settings: TrainingSettings, report: Progress) -> _Rows:
    system = features.system
    rng = np.random.default_rng([settings.seed, 0])
    noise = np.array([channel.noise for channel in system.channels])
    clean, truth = [], []
    count = settings.windows_per_record
    for done in range(0, settings.records, 100):
        per = min(100, settings.records - done)
        log_ratio = draw_log_ratios(system, per, settings.spread, rng)
        runs = simulate_runs(
            system, log_ratio, count * system.window, rng, speed=settings.speed, roughness=settings.roughness
        )
        windows = runs.clean.reshape(per * count, system.window, -1)
        clean.append(_rows(features, windows))
        truth.append(np.repeat(log_ratio, count, axis=0))
        report("simulate", done + per, settings.records, float("nan"))
    draws = [
        _rows(features, noise * rng.standard_normal((500, system.window, len(noise))))
        for _ in range(max(1, settings.records // 1000))
    ]
    return _Rows(torch.cat(clean), torch.cat(draws), torch.as_tensor(np.concatenate(truth)))


def _rows(features: ForceBalance, windows: FloatArray) -> Tensor:
    target, regressors = features(windows)
    return torch.cat([regressors, target.unsqueeze(2)], dim=2).float()


def _initialise(net: EstimatorNet, features: ForceBalance, settings: TrainingSettings) -> None:
    """Start from weights that are inverse to the noise of a row at nominal values."""
    net.noise.copy_(noise_power(features, np.random.default_rng([settings.seed, 1])))
    direction = torch.cat([torch.ones(net.architecture.parameters), -torch.ones(1)]).double()
    power = torch.einsum("rij,i,j->r", net.noise, direction, direction)
    net.log_weight.data = -0.5 * torch.log(power.clamp_min(power.max() * 1e-12))


class RunSettings(Protocol):
    """Settings that every training run needs."""

    @property
    def seed(self) -> int:
        """Seeds every step together with its number."""

    @property
    def learning_rate(self) -> float:
        """Of Adam, at the start."""

    @property
    def checkpoint_every(self) -> int:
        """Steps between checkpoints."""


class TrainingRun:
    """The network with its optimiser, saved every so often as tensors (never a pickle)."""

    def __init__(self, net: nn.Module, path: Path, settings: RunSettings, fingerprint: str) -> None:
        self.net, self.path, self.settings, self.fingerprint = net, path, settings, fingerprint
        self.step = 0
        self.optimiser = torch.optim.Adam(net.parameters(), lr=settings.learning_rate)

    def generator(self) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, 2, self.step])

    def rate(self, total: int) -> None:
        """Cosine decay of the learning rate to a hundredth."""
        share = min(1.0, self.step / max(1, total))
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * share)))

    def update(self, loss: Tensor, longest: float = 10.0) -> None:
        """A step of Adam along the gradient, which is cut to the length of `longest`."""
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), longest)
        self.optimiser.step()
        self.step += 1
        if self.step % self.settings.checkpoint_every == 0:
            self.save()

    def save(self) -> None:
        tensors = {f"net.{k}": v.contiguous() for k, v in self.net.state_dict().items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{k}": torch.as_tensor(v).contiguous() for k, v in state.items()}
        temporary = self.path.with_suffix(".new")
        save_file(tensors, temporary, metadata={"step": str(self.step), "fingerprint": self.fingerprint})
        temporary.replace(self.path.with_suffix(".safetensors"))

    def resume(self) -> None:
        """Go on from a checkpoint of this same training, if there is one."""
        path = self.path.with_suffix(".safetensors")
        if not path.is_file():
            return
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        if metadata.get("fingerprint") != self.fingerprint:
            return
        tensors = load_file(path)
        self.net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith("optimiser."):
                _, index, key = name.split(".", 2)
                state.setdefault(int(index), {})[key] = tensor
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": state, "param_groups": groups})
        self.step = int(metadata["step"])

    def forget(self) -> None:
        self.path.with_suffix(".safetensors").unlink(missing_ok=True)


def _fit_simulated(run: TrainingRun, settings: TrainingSettings, data: _Rows, report: Progress) -> None:
    while run.step < settings.steps:
        rng = run.generator()
        run.rate(settings.steps)
        pick = torch.as_tensor(rng.integers(len(data.clean), size=settings.batch))
        noise = torch.as_tensor(rng.integers(len(data.noise), size=settings.batch))
        sign = torch.as_tensor(rng.choice([-1.0, 1.0], size=settings.batch)).float()[:, None, None]
        rows = (data.clean[pick] + sign * data.noise[noise]).double()
        log_ratio, covariance = run.net(rows[:, :, -1], rows[:, :, :-1])
        loss = _likelihood(log_ratio - data.log_ratio[pick], covariance)
        run.update(loss)
        if run.step % 10 == 0 or run.step == settings.steps:
            report("train", run.step, settings.steps, float(loss.detach()))


def _likelihood(error: Tensor, covariance: Tensor) -> Tensor:
    """Negative log-likelihood per parameter, errors clipped softly so that rare failures do not rule."""
    factor, failed = torch.linalg.cholesky_ex(covariance)
    good = failed == 0
    whitened = torch.linalg.solve_triangular(factor[good], error[good].unsqueeze(2), upper=False).squeeze(2)
    square = whitened.square().mean(dim=1)
    log_determinant = 2 * torch.log(torch.diagonal(factor[good], dim1=1, dim2=2)).mean(dim=1)
    return (10 * torch.log1p(square / 10) + log_determinant).mean()


def _fit_recordings(
    run: TrainingRun, settings: TrainingSettings, features: ForceBalance, windows: FloatArray, report: Progress
) -> None:
    """Physics in the loop: the misfit of the simulated outputs, per degree of freedom, as the loss."""
    refiner = Refiner(features.system)
    total = settings.steps + settings.recording_steps
    batch = min(32, len(windows))
    while run.step < total:
        rng = run.generator()
        for group in run.optimiser.param_groups:
            group["lr"] = settings.learning_rate * 0.02
        chosen = windows[rng.choice(len(windows), batch, replace=False)]
        log_ratio, _ = run.net(*features(chosen))
        misfit, gradient = refiner.misfit(chosen, log_ratio.detach().numpy())
        # A surrogate with the gradient of the misfit: the simulator's own derivatives close the loop.
        surrogate = (log_ratio * torch.as_tensor(gradient)).sum(dim=1)
        freedom = refiner.observations - log_ratio.shape[1]
        run.update((surrogate / torch.as_tensor(misfit / freedom).clamp_min(1.0)).mean() / freedom)
        report("recordings", run.step - settings.steps, settings.recording_steps, float(misfit.mean() / freedom))


def _fingerprint(system: System, settings: TrainingSettings) -> str:
    return system.digest + " " + json.dumps(asdict(settings), sort_keys=True)
