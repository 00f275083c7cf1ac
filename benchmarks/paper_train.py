"""Rows of Fig. 5 and beyond: the train's 24 parameters, constant as in the paper, then changing per trajectory."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from sprung.benchmarks import paper_pictures
from sprung.benchmarks.bounds import shared_bound
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import train_fit
from sprung.model.alps.task import WINDOW, windows
from sprung.model.alps.train_fit import StateEstimator, TrainConfig, TrainMethod
from sprung.model.alps.train_system import STEPS, TRAJECTORIES, TrainData, full_state_system, generate, to_points
from sprung.model.identification.amortised.estimator import Estimator, bundled_estimator, new_estimator, noise_power
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.system import System, load_system

CONSTANT_METHODS = ("alps", "alps_smoothed", "no_fourier", "cdm", "alps_from_sensors", "alps_known_sensors")
CHANGING_METHODS = (
    "alps",
    "alps_many",
    "force_balance",
    "refined",
    "output_error",
    "refined_noisy_inputs",
    "refined_trajectory",
    "sensors_refined",
    "sensors_output_error",
)
PAPER = {"alps": {"SE": 3.02, "PE": 0.44e4, "PE_relative": 0.0042}, "cdm": {"SE": 56.04}}
UPDATES = {
    "quick": {
        "alps": 400, "alps_smoothed": 400, "no_fourier": 400, "cdm": 600, "alps_from_sensors": 2400,
        "alps_known_sensors": 1600,
    },
    "full": {
        "alps": 5000, "alps_smoothed": 5000, "no_fourier": 5000, "cdm": 20_000, "alps_from_sensors": 20_000,
        "alps_known_sensors": 20_000,
    },
}  # fmt: skip


MANY = 400  # trajectories, half of them to train: what the paper's estimator does with many vehicles


def data_of(changing: bool, seed: int = 0, trajectories: int = TRAJECTORIES) -> TrainData:
    """The data of a seed: the same for every method."""
    return generate(changing, np.random.default_rng([8, int(changing), seed]), trajectories)


def _config(settings: PaperSettings, method: str) -> TrainConfig:
    config = TrainConfig(seed=settings.seed, updates=UPDATES[settings.budget][method])
    if method in ("alps_from_sensors", "alps_known_sensors"):
        return replace(config, longest_gradient=1.0)  # with 10, one spike drove parameters to their bounds
    return config


def constant_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """The paper's benchmark: 20 trajectories, one parameter vector; SE over states in units of their rms."""
    data = data_of(False, settings.seed)
    _, test = train_fit.halves(data)
    yield _row(settings, "train", "guess_nominal", _mean_guess(data))
    if settings.method is None:
        yield from _bound_rows(settings, data)
    for method in CONSTANT_METHODS:
        if not settings.wants(method):
            continue
        config = _config(settings, method)
        begin = time.perf_counter()
        model = train_fit.fit(
            cast(TrainMethod, method), data, config, settings.folder, settings.clock, "train constant"
        )
        yield _row(
            settings, "train", method, train_fit.figures(model, data),
            seconds=round(time.perf_counter() - begin, 1), settings=asdict(config), paper=PAPER.get(method, {}),
        )  # fmt: skip
        if method == "alps" and settings.seed == 0:
            _states_picture(settings, model, data, int(test[0]))


def _bound_rows(settings: PaperSettings, data: TrainData) -> Iterator[dict[str, Any]]:
    """What the 12 accelerometers can tell of a constant vehicle: five windows of each training trajectory."""
    train, _ = train_fit.halves(data)
    starts = torch.arange(0, STEPS, WINDOW)
    rows, starts = train.repeat_interleave(len(starts)), starts.repeat(len(train))
    states, known = windows(data.states, starts, rows), windows(data.known, starts, rows)
    for method, free in (("bound_known_sensors", False), ("bound_from_sensors", True)):
        deviation = shared_bound(load_system(), data.log_ratio[0], states, known, free=free)
        yield _row(settings, "train", method, {"PE_relative": float(np.sqrt(2 / np.pi) * deviation.mean())})


def changing_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """Every trajectory with its own parameters: the paper's estimator, and what keeps the phase."""
    data = data_of(True, settings.seed)
    yield _row(settings, "train_changing", "guess_nominal", _mean_guess(data))
    for method, seen in (("alps", data), ("alps_many", data_of(True, settings.seed, MANY))):
        if not settings.wants(method):
            continue
        config = replace(_config(settings, "alps"), decay=0.0)  # decay suits parameters that never change
        folder = settings.folder / method
        folder.mkdir(exist_ok=True)
        model = train_fit.fit("alps", seen, config, folder, settings.clock, f"changing {method}")
        yield _row(
            settings, "train_changing", method, train_fit.figures(model, seen), settings=asdict(config),
            vehicles=len(seen.states) // 2, note="the paper's estimator on parameters that it has not seen",
        )  # fmt: skip
    yield from _refined_rows(settings, data)
    yield from _sensor_rows(settings, data)


@dataclass(frozen=True)
class _Case:
    """Measured states of test windows as the refinement takes them."""

    system: System
    measured: np.ndarray  # inputs and points, (B, T, 16 + 18)
    truth: np.ndarray  # log-ratios, (B, 24)
    states: np.ndarray  # (B, T, 18)


def _case(data: TrainData, starts: Tensor, length: int, known_inputs: bool) -> _Case:
    _, test = train_fit.halves(data)
    rows, starts = test.repeat_interleave(len(starts)), starts.repeat(len(test))
    inputs = windows(data.known if known_inputs else data.knots, starts, rows, length).numpy()
    points = to_points(windows(data.measured, starts, rows, length).numpy())
    return _Case(
        full_state_system(load_system(), data.noise.numpy(), known_inputs),
        np.concatenate([inputs, points], axis=2),
        data.log_ratio[rows].numpy(),
        windows(data.states, starts, rows, length).numpy(),
    )


def _refined_rows(settings: PaperSettings, data: TrainData) -> Iterator[dict[str, Any]]:
    """From measured states: force balance alone, refined from it, refined from the nominal values."""
    starts = torch.arange(0, STEPS - WINDOW + 1, 25 if settings.budget == "quick" else 10)
    second = _case(data, starts, WINDOW, known_inputs=True)
    balance = _balance(second) if settings.wants("force_balance") or settings.wants("refined") else None
    if settings.wants("force_balance") and balance is not None:
        yield _row(
            settings, "train_changing", "force_balance", _figures(balance, second.truth), windows=len(second.truth),
            note="phase-keeping spectra of displacements, weighted by noise, untrained",
        )  # fmt: skip
    if settings.wants("refined"):
        yield _refine(settings, data, "refined", second, balance)
    if settings.wants("output_error"):
        yield _refine(settings, data, "output_error", second, None)
    if settings.wants("refined_noisy_inputs"):
        yield _refine(settings, data, "refined_noisy_inputs", _case(data, starts, WINDOW, known_inputs=False), None)
    if settings.wants("refined_trajectory"):
        whole = _case(data, torch.zeros(1, dtype=torch.long), STEPS, known_inputs=False)
        yield _refine(settings, data, "refined_trajectory", whole, None)


def _balance(case: _Case) -> np.ndarray:
    """Log-ratios by the service's force-balance network before training: rows weighted by their noise."""
    net = new_estimator(case.system)
    estimator = Estimator(case.system, net)
    power = noise_power(estimator.features, np.random.default_rng(0), windows=400)
    net.noise.copy_(power)
    direction = torch.cat([torch.ones(len(case.system.parameters)), -torch.ones(1)]).double()
    rows = torch.einsum("rij,i,j->r", power, direction, direction)
    net.log_weight.data = -0.5 * torch.log(rows.clamp_min(rows.max() * 1e-12))
    return estimator.estimate(case.measured).log_ratio


def _refine(
    settings: PaperSettings, data: TrainData, method: str, case: _Case, first: np.ndarray | None
) -> dict[str, Any]:
    begin = time.perf_counter()
    found = Refiner(case.system, case.measured.shape[1]).refine(case.measured, first, states=True)
    seconds = time.perf_counter() - begin
    error = (found.states - case.states) / data.size.numpy()
    return _row(
        settings, "train_changing", method,
        {"SE": float((error**2).sum((1, 2)).mean()), **_figures(found.log_ratio, case.truth)},
        windows=len(case.truth), samples=case.measured.shape[1], converged=float(found.converged.mean()),
        iterations=float(found.iterations.mean()), milliseconds_per_window=round(1e3 * seconds / len(case.truth), 1),
        error_at_bound=_bound(found.covariance),
    )  # fmt: skip


def _sensor_rows(settings: PaperSettings, data: TrainData) -> Iterator[dict[str, Any]]:
    """From the 12 accelerometers: the service, and the refinement from the nominal values."""
    system = load_system()
    _, test = train_fit.halves(data)
    starts = torch.arange(0, STEPS - WINDOW + 1, 25 if settings.budget == "quick" else 10)
    rows, starts = test.repeat_interleave(len(starts)), starts.repeat(len(test))
    measured = torch.cat([windows(data.knots, starts, rows), windows(data.observations, starts, rows)], dim=2).numpy()
    truth = data.log_ratio[rows].numpy()
    for method in ("sensors_refined", "sensors_output_error"):
        if not settings.wants(method):
            continue
        first = None
        estimator = bundled_estimator(system)
        if estimator is not None and method == "sensors_refined":
            first = estimator.estimate(measured).log_ratio
        elif method == "sensors_refined":
            continue  # no trained weights for this system here
        found = Refiner(system).refine(measured, first)
        yield _row(
            settings, "train_changing", method, _figures(found.log_ratio, truth), windows=len(truth),
            converged=float(found.converged.mean()), iterations=float(found.iterations.mean()),
            error_at_bound=_bound(found.covariance),
            start_PE_relative=None if first is None else _figures(first, truth)["PE_relative"],
        )  # fmt: skip


def _bound(covariance: np.ndarray) -> float:
    """Mean absolute error that Gaussian errors of the predicted covariances (B, P, P) have."""
    return float(np.sqrt(2 / np.pi) * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).mean())


def _figures(log_ratio: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    return train_fit.parameter_figures(torch.from_numpy(log_ratio), torch.from_numpy(truth))


def _mean_guess(data: TrainData) -> dict[str, float | None]:
    _, test = train_fit.halves(data)
    truth = data.log_ratio[test]
    return train_fit.parameter_figures(torch.zeros_like(truth), truth)


def _row(
    settings: PaperSettings, task: str, method: str, figures: Mapping[str, float | None], /, **more: Any
) -> dict[str, Any]:
    rounded = {key: None if value is None else float(f"{value:.4g}") for key, value in figures.items()}
    return {"task": task, "method": method, **rounded, "seed": settings.seed, "budget": settings.budget, **more}


def _states_picture(settings: PaperSettings, model: torch.nn.Module, data: TrainData, row: int) -> None:
    assert isinstance(model, StateEstimator)
    measured, knots = data.measured[row : row + 1, :WINDOW], data.known[row : row + 1, :WINDOW]
    with torch.no_grad():
        _, simulated = model(measured, knots)
    names = model.task.states
    lines = {
        names[i]: {
            "true": data.states[row, :WINDOW, i].numpy(),
            "measured": measured[0, :, i].numpy(),
            "simulated": simulated[0, :, i].numpy(),
        }
        for i in (0, 1, 3, 5)
    }
    paper_pictures.train_states(np.arange(WINDOW) / 100, lines, settings.pictures / "train-states.png")
