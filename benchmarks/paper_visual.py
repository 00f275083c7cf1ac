"""Rows of Fig. 4: pendulum, double mass-spring-damper, two-body system; SE, OE, PE of five methods."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from sprung.benchmarks import paper_pictures
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import evaluate, mass_spring_damper, pendulum, two_body
from sprung.model.alps.config import METHODS, NetworkConfig, training_config
from sprung.model.alps.evaluate import Predicted
from sprung.model.alps.fit import Split, VisualModel, embedded, train_frames, train_method
from sprung.model.alps.task import Task

__all__ = ["METHODS", "rows"]

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


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per method."""
    task = TASKS[settings.task]
    config = training_config(task.name, settings.budget, settings.seed)
    sizes = NetworkConfig()
    shared = training_config(task.name, settings.budget, 0)  # frames are the same for every seed
    frames = train_frames(task, shared, sizes, settings.folder, settings.clock, settings.device)
    splits = {
        name: embedded(task, shared, frames, name, settings.folder, settings.device)
        for name in ("train", "test", "unseen")
    }
    shown: dict[str, Predicted] = {}
    models: dict[str, VisualModel] = {}
    for method in METHODS:
        if not settings.wants(method):
            continue
        begin, busy = time.perf_counter(), time.process_time()
        model = train_method(
            task, method, splits["train"], frames, config, sizes, settings.folder,
            settings.clock, settings.device,
        )  # fmt: skip
        seconds, processor = time.perf_counter() - begin, time.process_time() - busy
        row, shown[method] = _row(task, method, model, splits)
        models[method] = model
        yield row | {
            "seed": settings.seed,
            "budget": settings.budget,
            "seconds": round(seconds, 1),
            "processor_seconds": round(processor, 1),
            "weights": sum(p.numel() for p in model.network.parameters()),
            "settings": asdict(config),
        }
    if settings.seed == 0 and settings.method is None:  # a picture shows all methods side by side
        paper_pictures.states(task, shown, settings.pictures / f"{task.name}-states.png")
        paper_pictures.frames(task, models, shown, settings.pictures / f"{task.name}-frames.png")


def _row(task: Task, method: str, model: VisualModel, splits: dict[str, Split]) -> tuple[dict[str, Any], Predicted]:
    train, test, unseen = splits["train"], splits["test"], splits["unseen"]
    found = evaluate.predict(task, model, test, *evaluate.every_window(test), train)
    figures: dict[str, Any] = evaluate.state_figures(task, found)
    few = torch.arange(min(evaluate.SHOWN_WINDOWS, len(test.embeddings)))
    shown = evaluate.predict(task, model, test, few, few % 26, train)
    figures["OE"] = evaluate.observation_error(task, model, shown)
    if found.parameters is not None:
        beyond = evaluate.predict(task, model, unseen, *evaluate.every_window(unseen), train)
        outside = evaluate.state_figures(task, beyond)
        figures["PE_unseen"], figures["PE_unseen_relative"] = outside["PE"], outside["PE_relative"]
    paper = dict(zip(("SE", "OE", "PE"), PAPER[task.name, method], strict=True))
    figures = {key: None if value is None else float(f"{value:.4g}") for key, value in figures.items()}
    return {"task": task.name, "method": method, **figures, "paper": paper, "windows": len(found.true)}, shown
