"""Training and figures of the train task: the paper's estimator on states, CDM, and ALPS from 12 accelerometers."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from sprung.model.alps import metrics
from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.context import ContextDynamics
from sprung.model.alps.embedding import FeedForwardEmbedding
from sprung.model.alps.encoder import AttentionEncoder
from sprung.model.alps.fit import TimeLimit
from sprung.model.alps.task import WINDOW, Task, windows
from sprung.model.alps.train_estimator import LogRatioEstimator
from sprung.model.alps.train_system import STEPS, TrainData, smoothed, train_task
from sprung.model.identification.amortised.features import magnitudes
from sprung.model.identification.amortised.training import TrainingRun
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import load_system

_RIDGE = 1e-6  # of the diagonal

TrainMethod = Literal["alps", "alps_smoothed", "no_fourier", "cdm", "alps_from_sensors", "alps_known_sensors"]


@dataclass(frozen=True)
class TrainConfig:
    """Settings of one training run on the train task; ours, as the paper gives none."""

    seed: int = 0
    updates: int = 400
    batch: int = 16
    learning_rate: float = 6e-3
    decay: float = 30.0  # decoupled weight decay: the data have one parameter vector, so the network should be flat
    checkpoint_every: int = 100
    divergence_weight: float = 1e-5
    observation_weight: float = 20.0  # ALPS from sensors: with 1, simulations follow what is badly encoded
    nominal: float = 0.2  # of the updates: parameters rest there until states mean something
    longest_gradient: float = 10.0


class StateEstimator(nn.Module):
    """The paper's setting: measured states -> features -> parameters -> simulated states.

    `smooth` holds the noise of the states where the simulation starts from the window's best start rather than, as in
    the paper, from its first measured sample.
    """

    def __init__(self, task: Task, fourier: bool, smooth: Tensor | None = None) -> None:
        super().__init__()
        self.smooth, self.simulator = smooth, LinearSimulator(load_system())
        self.task, self.fourier = task, fourier
        rows = WINDOW // 2 + 1 if fourier else WINDOW
        self.estimator = LogRatioEstimator(rows * len(task.states), len(task.parameters))

    def forward(self, states: Tensor, knots: Tensor) -> tuple[Tensor, Tensor]:
        """Measured states (B, T, 18), knots (B, T, 16) -> log-ratios (B, 24), simulated states (B, T, 18)."""
        chart = self.task.to_chart(states).float()
        features = torch.log1p(magnitudes(chart)) if self.fourier else chart.flatten(1)
        log_ratio = self.estimator(features).double()
        if self.smooth is not None:
            return log_ratio, smoothed(self.simulator, log_ratio, states, knots, self.smooth)
        return log_ratio, self.task.simulate(states[:, 0], log_ratio, knots)


class StateContext(nn.Module):
    """CDM on measured states: context from the first samples, then a learned step."""

    def __init__(self, task: Task, data: TrainData) -> None:
        super().__init__()
        self.model = ContextDynamics(task, NetworkConfig())
        self.register_buffer("drive", data.knots[data.training].square().mean((0, 1)).sqrt().float())
        self.drive: Tensor

    def forward(self, states: Tensor, knots: Tensor, horizon: int = WINDOW - 1) -> Tensor:
        """Measured states (B, T, 18), knots (B, T, 16) -> predicted states (B, T, 18) from every `horizon`-th one."""
        batch, samples, size = states.shape
        states, knots = states.float(), knots.float() / self.drive
        context = self.model.describe(states, knots)
        start = states[:, : samples - 1 : horizon].reshape(-1, size)
        steps = torch.arange((samples - 1) // horizon)[:, None] * horizon + torch.arange(horizon + 1)
        path = self.model(start, context, knots[:, steps].flatten(0, 1))
        segments = len(steps)
        return torch.cat([path[::segments, :1], path[:, 1:].reshape(batch, samples - 1, size)], dim=1).double()


class Readout(nn.Module):
    """Linear decoder that is never behind: least squares over every batch (variable projection, Golub & Pereyra 1973).

    A decoder that is trained beside the parameters takes over what is their business and never gives it back; here
    their gradient is of what no map of the states explains.
    """

    def __init__(self, columns: int, sensors: int) -> None:
        super().__init__()
        self.register_buffer("matrix", torch.zeros(columns, sensors, dtype=torch.float64))
        self.matrix: Tensor

    def forward(self, seen: Tensor, shown: Tensor) -> Tensor:
        """States and inputs (B, T, columns), what the sensors showed (B, T, sensors) -> decoded (B, T, sensors)."""
        if self.training:
            with torch.no_grad():  # at the best map, its own change does not change the error
                rows = seen.flatten(0, 1)
                normal = rows.mT @ rows
                normal += _RIDGE * torch.diag(normal.diagonal())
                self.matrix = torch.linalg.solve(normal, rows.mT @ shown.flatten(0, 1))
        return seen @ self.matrix


class SensorAutoencoder(nn.Module):
    """ALPS from 12 accelerometers and the wheels: embedding, attention, estimator, simulator, decoder.

    The decoder is a linear map of state and inputs, or, where it is `known` what the sensors measure, the sensors' own
    equation.
    """

    def __init__(self, task: Task, data: TrainData, known: bool) -> None:
        super().__init__()
        config = NetworkConfig()
        self.task, self.simulator = task, LinearSimulator(load_system())
        self.register_buffer("scale", data.observations[data.training].square().mean((0, 1)).sqrt())
        self.register_buffer("drive", data.knots[data.training].square().mean((0, 1)).sqrt())
        self.scale: Tensor
        self.drive: Tensor
        sensors, inputs = len(self.scale), len(self.drive)
        self.embed = FeedForwardEmbedding(sensors + inputs, config)
        self.encoder = AttentionEncoder(task, config)
        self.estimator = LogRatioEstimator((WINDOW // 2 + 1) * len(task.states), len(task.parameters))
        self.decoder = None if known else Readout(len(task.states) + inputs, sensors)

    # four values, which the classes that call it name
    def forward(self, observations: Tensor, knots: Tensor, nominal: bool = False):  # type: ignore[no-untyped-def]
        """(B, T, 12), (B, T, 16) -> posterior, log-ratios, simulated states, decoded observations / scale.

        `nominal` holds the parameters there: until states mean something, the estimator would learn to hide motion.
        """
        drive = knots / self.drive
        encoded = self.encoder(self.embed(torch.cat([observations / self.scale, drive], dim=-1).float()))
        states = encoded.draw if self.training else encoded.mean
        chart = self.task.to_chart(states)
        log_ratio = self.estimator(torch.log1p(magnitudes(chart))).double()
        if nominal:
            log_ratio = torch.zeros_like(log_ratio)
        measured, simulated = self.follow(log_ratio, knots, states)
        if self.decoder is None:
            assert measured is not None
            return encoded, log_ratio, simulated, measured / self.scale
        seen = torch.cat([self.task.to_chart(simulated), drive], dim=-1)
        return encoded, log_ratio, simulated, self.decoder(seen, observations / self.scale)

    def follow(self, log_ratio: Tensor, knots: Tensor, states: Tensor) -> tuple[Tensor | None, Tensor]:
        """What the sensors show (B, T, 12) and the states (B, T, 18) from the first of the encoded states."""
        return self.simulator.simulate(log_ratio, knots, states[:, 0].double())


def halves(data: TrainData) -> tuple[Tensor, Tensor]:
    """Rows (N / 2,) of the training and the test trajectories: 50-50."""
    half = len(data.states) // 2
    return torch.arange(half), torch.arange(half, len(data.states))


def build(method: TrainMethod, data: TrainData) -> nn.Module:
    """An untrained model."""
    if method in ("alps_from_sensors", "alps_known_sensors"):
        task = train_task(data, data.expected_size())
        return SensorAutoencoder(task, data, known=method == "alps_known_sensors")
    task = train_task(data)
    if method == "cdm":
        return StateContext(task, data)
    smooth = data.noise if method == "alps_smoothed" else None
    return StateEstimator(task, fourier=method != "no_fourier", smooth=smooth)


def fit(
    method: TrainMethod, data: TrainData, config: TrainConfig, folder: Path, clock: TimeLimit, what: str
) -> nn.Module:
    """Train on the first half of the trajectories, without labels; or go on from the checkpoint."""
    torch.manual_seed(config.seed)
    model = build(method, data)
    train, _ = halves(data)
    run = TrainingRun(
        model, folder / f"{method}-s{config.seed}", config, f"{what} {method} " + json.dumps(asdict(config))
    )
    run.resume()
    model.train()
    while run.step < config.updates:
        clock.check(run)
        rng = np.random.default_rng([config.seed, 6, run.step])
        rows = train[torch.from_numpy(rng.integers(len(train), size=config.batch))]
        starts = torch.from_numpy(rng.integers(STEPS - WINDOW + 1, size=config.batch))
        torch.manual_seed(config.seed * 1_000_003 + run.step)
        run.rate(config.updates)
        run.update(loss_of(model, data, rows, starts, config, run.step), config.longest_gradient)
        _shrink(model, run.optimiser.param_groups[0]["lr"] * config.decay)
        if run.step == config.updates:
            run.save()
    return model.eval()


def loss_of(model: nn.Module, data: TrainData, rows: Tensor, starts: Tensor, config: TrainConfig, step: int) -> Tensor:
    """The method's loss on windows (rows, starts), both (B,), at an update."""
    measured, known = windows(data.measured, starts, rows), windows(data.known, starts, rows)
    if isinstance(model, StateEstimator):
        _, simulated = model(measured, known)
        return ((simulated - measured) / data.noise).square().mean()
    if isinstance(model, StateContext):
        horizon = (3, 9, 33)[min(2, 3 * step // config.updates)]
        size = measured.new_tensor(model.model.task.state_scale)
        return ((model(measured, known, horizon) - measured) / size).square().mean()
    observations, knots = windows(data.observations, starts, rows), windows(data.knots, starts, rows)
    assert isinstance(model, SensorAutoencoder)
    encoded, _, simulated, decoded = model(observations, knots, nominal=step < config.nominal * config.updates)
    divergence = encoded.divergence.mean()
    observation = (decoded - observations / model.scale).square().mean()
    state = ((encoded.draw - simulated) / simulated.new_tensor(model.task.state_scale)).square().sum(-1).mean()
    return config.divergence_weight * divergence + config.observation_weight * observation + 0.1 * state


@torch.no_grad()
def _shrink(model: nn.Module, share: float) -> None:
    """Decoupled weight decay of the estimator's matrices (biases stay)."""
    if isinstance(model, (StateEstimator, SensorAutoencoder)):
        for name, weight in model.estimator.named_parameters():
            if name.endswith("weight"):
                weight.mul_(1 - min(0.5, share))


@torch.no_grad()
def figures(model: nn.Module, data: TrainData, hop: int = 10) -> dict[str, float | None]:
    """SE and PE over the windows of the test trajectories; states in units of their rms, parameters in SI."""
    _, test = halves(data)
    starts = torch.arange(0, STEPS - WINDOW + 1, hop)
    rows, starts = test.repeat_interleave(len(starts)), starts.repeat(len(test))
    measured, known = windows(data.measured, starts, rows), windows(data.known, starts, rows)
    true = windows(data.states, starts, rows)
    log_ratio = None
    if isinstance(model, StateEstimator):
        log_ratio, simulated = model(measured, known)
    elif isinstance(model, StateContext):
        simulated = model(measured, known)
    else:
        _, log_ratio, simulated, _ = model(windows(data.observations, starts, rows), windows(data.knots, starts, rows))
    error = (simulated - true) / data.size
    found: dict[str, float | None] = {
        "SE": float(error.square().sum((1, 2)).mean()),
        "SE_relative": float(error.square().mean().sqrt()),
        "PE": None,
        "PE_relative": None,
    }
    if log_ratio is not None:
        found |= parameter_figures(log_ratio, data.log_ratio[rows])
    return found


def parameter_figures(log_ratio: Tensor, true: Tensor) -> dict[str, float | None]:
    """PE in SI units and the mean relative error, from log-ratios (B, 24)."""
    nominal = torch.from_numpy(load_system().nominal)
    estimated, truth = nominal * torch.exp(log_ratio), nominal * torch.exp(true)
    return {
        "PE": metrics.parameter_error(estimated, truth),
        "PE_relative": metrics.relative_parameter_error(estimated, truth),
    }
