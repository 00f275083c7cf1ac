"""Rows of Fig. 4: pendulum, double mass-spring-damper, two-body system; SE, OE, PE and what they leave open.

Beside the paper's five methods: answers without training, the methods as printed, each departure left out, and two
methods that are not the paper's (`model.alps.config.RECIPES`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sprung.benchmarks import paper_pictures
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import evaluate, mass_spring_damper, metrics, output_error, pendulum, two_body
from sprung.model.alps.config import METHODS as TRAINED
from sprung.model.alps.config import RECIPES, NetworkConfig, TrainingConfig, for_recipe, training_config
from sprung.model.alps.evaluate import Predicted
from sprung.model.alps.fit import Split, VisualModel, embedded, seen_by, train_frames, train_method
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.task import ROLLOUT, WINDOW, Task, windows

TASKS = {module.TASK.name: module.TASK for module in (pendulum, mass_spring_damper, two_body)}
PAPER: dict[tuple[str, str], tuple[float, float, float | None]] = {  # (SE, OE, PE), Fig. 4 of the paper
    ("pendulum", "cdm"): (345.22, 1766.70, None),
    ("pendulum", "autoencoder"): (3041.12, 600.84, None),
    ("pendulum", "alps"): (86.48, 1696.91, 0.06),
    ("pendulum", "no_fourier"): (90.82, 1773.39, 0.29),
    ("pendulum", "no_attention"): (181.22, 1950.77, 0.06),
    ("mass_spring_damper", "cdm"): (0.99, 5.69e8, None),
    ("mass_spring_damper", "autoencoder"): (7.63, 7.42e8, None),
    ("mass_spring_damper", "alps"): (0.29, 7.43e8, 0.60e6),
    ("mass_spring_damper", "no_fourier"): (0.93, 7.44e8, 2.28e6),
    ("mass_spring_damper", "no_attention"): (1.85, 7.44e8, 1.87e6),
    ("two_body", "cdm"): (50.23, 2.03e8, None),
    ("two_body", "autoencoder"): (95.80, 2.71e8, None),
    ("two_body", "alps"): (0.45, 2.59e8, 0.02),
    ("two_body", "no_fourier"): (1.86, 2.56e8, 0.02),
    ("two_body", "no_attention"): (511.49, 2.72e8, 0.27),
}


def system_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """What the three systems look like, and how long a picture takes."""
    drawn = {}
    for name, task in TASKS.items():
        assert task.render is not None
        states = task.sample(8, np.random.default_rng(settings.seed), task.seen).states
        begin = time.perf_counter()
        task.render(states.flatten(0, 1))
        milliseconds = 1e3 * (time.perf_counter() - begin) / states[..., 0].numel()
        drawn[name] = task.render(states[0, ::14])
        yield {
            "task": "systems",
            "method": name,
            "milliseconds_per_picture": round(milliseconds, 3),
            "state_spread": [float(f"{v:.3g}") for v in states.std((0, 1))],
        }
    paper_pictures.systems(drawn, settings.pictures / "systems.png")


UNTRAINED = ("zero", "opening", "output_error")  # answering zero; reading and differencing; classical identification
METHODS = (*UNTRAINED, *TRAINED)
_PICTURED = {"alps", "cdm", "autoencoder"}  # pictures are drawn when one command made all of these
_STARTS = torch.arange(0, ROLLOUT - WINDOW + 1, 5)  # of the windows of the classical fit: six of each trajectory


@dataclass(frozen=True)
class _Data:
    """What the methods of a task share for one seed."""

    task: Task
    config: TrainingConfig
    frames: FrameAutoencoder
    splits: dict[str, Split]  # train, test, unseen, below, noisy


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per method; data, frames and networks are all drawn from the seed."""
    data = _data(settings)
    for method in UNTRAINED:
        if settings.wants(method):
            begin = time.process_time()
            figures, errors = _untrained(method, data)
            _keep_errors(settings, method, errors)
            yield _row(settings, method, figures) | {"processor_seconds": round(time.process_time() - begin, 1)}
    shown: dict[str, Predicted] = {}
    models: dict[str, VisualModel] = {}
    for method in TRAINED:
        if not settings.wants(method):
            continue
        begin, busy = time.perf_counter(), time.process_time()
        model = train_method(
            data.task, method, data.splits["train"], data.frames, data.config, NetworkConfig(), settings.folder,
            settings.clock, settings.device,
        )  # fmt: skip
        seconds, processor = time.perf_counter() - begin, time.process_time() - busy
        figures, errors, shown[method] = _figures(data, model)
        models[method] = model
        _keep_errors(settings, method, errors)
        yield _row(settings, method, figures) | {
            "seconds": round(seconds, 1),
            "processor_seconds": round(processor, 1),
            "weights": sum(p.numel() for p in model.network.parameters()),
            "settings": asdict(for_recipe(data.config, RECIPES[method])) | asdict(RECIPES[method]),
        }
    if settings.seed == 0 and models.keys() >= _PICTURED:  # a picture shows methods side by side
        paper_pictures.states(data.task, shown, settings.pictures / f"{data.task.name}-states.png")
        paper_pictures.frames(data.task, models, shown, settings.pictures / f"{data.task.name}-frames.png")


def _data(settings: PaperSettings) -> _Data:
    task = TASKS[settings.task]
    config = training_config(task.name, settings.budget, settings.seed)
    folder = settings.folder / f"seed-{settings.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    frames = train_frames(task, config, NetworkConfig(), folder, settings.clock, settings.device)
    few = replace(config, test_trajectories=min(100, config.test_trajectories))
    splits = {
        name: embedded(task, chosen, frames, name, folder, settings.device)
        for name, chosen in (("train", config), ("test", config), ("unseen", few), ("below", few))
    }
    splits["noisy"] = evaluate.noisy(frames, task, splits["test"])
    return _Data(task, config, frames, splits)


def _untrained(method: str, data: _Data) -> tuple[dict[str, float | None], dict[str, np.ndarray]]:
    """Figures of a method without a network, and its errors by trajectory."""
    task, test = data.task, data.splits["test"]
    rows = torch.arange(len(test.embeddings)).repeat_interleave(len(_STARTS))
    starts = _STARTS.repeat(len(test.embeddings))
    reading = None
    if method == "opening":
        reading = output_error.opened(task, data.splits["train"])
    elif method == "output_error":
        reading = output_error.calibrated(task, data.splits["train"])
    answered = _answered(task, method, reading, test, rows, starts)
    if method == "zero":
        figures = evaluate.state_figures(task, answered)
        figures["SE_affine"] = figures["SE"]
        return figures, evaluate.by_trajectory(task, answered, rows)
    move = metrics.aligned(task, answered.encoded, answered.true)
    moved = replace(answered, encoded=move(answered.encoded), simulated=move(answered.simulated))
    figures = evaluate.state_figures(task, moved)
    like = data.splits["train"]
    few = torch.arange(min(400, len(like.embeddings)))
    fitted = _answered(task, method, reading, like, few, few % len(_STARTS) * 5)
    affine = metrics.affine_gauge(task, fitted.simulated, fitted.true)
    found = replace(moved, simulated=affine(answered.simulated))
    figures |= _gauge_free(task, found)
    if method == "output_error" and reading is not None:
        for name in ("unseen", "below", "noisy"):
            other = data.splits[name]
            few = torch.arange(len(other.embeddings))
            beyond = evaluate.state_figures(task, _answered(task, method, reading, other, few, few % 26))
            figures[f"PE_{name}"], figures[f"PE_{name}_relative"] = beyond["PE"], beyond["PE_relative"]
        figures["forecast_relative"] = _forecast_error(task, reading, test, affine)
    return figures, evaluate.by_trajectory(task, found, rows)


def _answered(
    task: Task, method: str, reading: output_error.PositionReading | None, split: Split, rows: Tensor, starts: Tensor
) -> Predicted:
    """What an untrained method answers for windows of a split."""
    true = windows(split.rollouts.states, starts, rows)
    parameters = None
    if reading is None:
        states = simulated = torch.zeros_like(true)
    else:
        read = reading(windows(split.embeddings, starts, rows))
        states = simulated = output_error.differences(task, read)
        if method == "output_error":
            fitted = output_error.fit_windows(task, read, windows(split.rollouts.inputs, starts, rows))
            simulated, parameters = fitted.simulated, fitted.parameters
    return Predicted(true, states, simulated, None, parameters, split.rollouts.parameters[rows])


def _forecast_error(task: Task, reading: output_error.PositionReading, split: Split, move: evaluate.Move) -> float:
    """As `evaluate.forecast_error`: the first window of each trajectory is fitted, what follows is simulated."""
    inputs = split.rollouts.inputs
    fitted = output_error.fit_windows(task, reading(split.embeddings[:, :WINDOW]), inputs[:, :WINDOW])
    beyond = move(fitted.forecast(task, inputs))[:, WINDOW:]
    return metrics.relative_state_error(task, beyond, split.rollouts.states[:, WINDOW:])


def _gauge_free(task: Task, found: Predicted) -> dict[str, float | None]:
    """SE and R^2 of each state after the affine map."""
    figures: dict[str, float | None] = {
        "SE_affine": metrics.state_error(task, found.simulated, found.true),
        "SE_affine_relative": metrics.relative_state_error(task, found.simulated, found.true),
    }
    for name, share in zip(task.states, metrics.explained(task, found.simulated, found.true), strict=True):
        figures[f"R2 {name.split()[0]}"] = share
    return figures


def _figures(data: _Data, model: VisualModel) -> tuple[dict[str, float | None], dict[str, np.ndarray], Predicted]:
    """Figures of a trained method, its errors by trajectory, and the windows that pictures show."""
    task = data.task
    splits = {name: seen_by(model, task, split, data.config) for name, split in data.splits.items() if name != "noisy"}
    splits["noisy"] = data.splits["noisy"]
    if data.config.end_to_end:
        splits["noisy"] = evaluate.noisy(model.frames, task, splits["test"])
    train, test = splits["train"], splits["test"]
    move, affine = evaluate.symmetry(task, model, train), evaluate.gauge(task, model, train)
    rows, starts = evaluate.every_window(test)
    figures = evaluate.state_figures(task, evaluate.predict(model, test, rows, starts, move))
    free = evaluate.predict(model, test, rows, starts, affine)
    figures |= _gauge_free(task, free)
    figures["forecast_relative"] = evaluate.forecast_error(task, model, test, affine)
    few = torch.arange(min(evaluate.SHOWN_WINDOWS, len(test.embeddings)))
    shown = evaluate.predict(model, test, few, few % 26, move)
    figures["OE"] = evaluate.observation_error(task, model, shown)
    for name in ("unseen", "below", "noisy"):
        found = evaluate.predict(model, splits[name], *evaluate.every_window(splits[name]), affine)
        outside = evaluate.state_figures(task, found)
        figures[f"SE_{name}_relative"] = outside["SE_relative"]
        if found.parameters is not None:
            figures[f"PE_{name}"], figures[f"PE_{name}_relative"] = outside["PE"], outside["PE_relative"]
    return figures, evaluate.by_trajectory(task, free, rows), shown


def _keep_errors(settings: PaperSettings, method: str, errors: dict[str, np.ndarray]) -> None:
    """Gauge-free SE and PE of each test trajectory, for intervals and paired tests in the report."""
    folder = settings.out / settings.budget / "errors"
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{settings.task}-{method}-s{settings.seed}.npz", **errors)  # type: ignore[arg-type]  # as arrays


def _row(settings: PaperSettings, method: str, figures: dict[str, float | None]) -> dict[str, Any]:
    paper = dict(zip(("SE", "OE", "PE"), PAPER.get((settings.task, method), ()), strict=False))
    rounded = {key: None if value is None else float(f"{value:.4g}") for key, value in figures.items()}
    return {
        "task": settings.task, "method": method, **rounded, "paper": paper,
        "seed": settings.seed, "budget": settings.budget,
    }  # fmt: skip
