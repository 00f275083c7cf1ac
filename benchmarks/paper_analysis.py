"""Rows of the analysis: kernels of Fig. 3, when magnitudes lose the parameters, and what the two features allow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from sprung.benchmarks import paper_pictures
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.benchmarks.paper_visual import TASKS
from sprung.model.alps import kernels, metrics, phase
from sprung.model.alps.config import NetworkConfig, TrainingConfig, training_config
from sprung.model.alps.estimator import AlpsEstimator, Features, log_magnitudes, raw
from sprung.model.alps.fit import draw_rollouts, pick_windows
from sprung.model.alps.task import ROLLOUT, WINDOW, Rollouts, Task, windows

INPUTS = (1, 2, 4, 8)
FEATURE_TRAJECTORIES = (500, 8000)  # the paper's number, and more than enough
FEATURE_UPDATES = 6000
FEATURE_BATCH = 64


def kernel_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """Spectra of the four composed kernels on the paper's signal."""
    views = {name: kernels.view(name) for name in kernels.FEATURES}
    for name, found in views.items():
        yield {
            "task": "kernels",
            "method": name,
            "first_eigenvalue_share": round(float(found.eigenvalues[0]), 4),
            "eigenvalues_above_0.1_percent_of_first": found.width(),
            "upper_half_band_share_of_row_spectrum": round(found.high_share(), 4),
            "row_minimum": round(float(found.row.min()), 4),
        }
    paper_pictures.kernels(views, settings.pictures / "kernels.png")


def phase_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """Mean relative error of the spring constants over the number of independent inputs."""
    windows, updates = (10_000, 600) if settings.budget == "quick" else (100_000, 10_000)
    rows = []
    for inputs in INPUTS:
        row = {
            "inputs": inputs,
            "guess": phase.guess_error(),
            "magnitude": phase.network_error("magnitude", inputs, windows, updates, settings.seed),
            "phase": phase.network_error("phase", inputs, windows, updates, settings.seed),
            "balance": phase.balance_error(inputs, settings.seed),
        }
        rows.append(row)
        yield {"task": "phase", "seed": settings.seed, "windows": windows, "updates": updates} | {
            k: round(v, 5) for k, v in row.items()
        }
    if settings.seed == 0:
        paper_pictures.phases(rows, settings.pictures / "phase.png")


def feature_rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """PE of the estimator from true states, trained with labels, over the number of trajectories it learns from.

    Magnitudes throw the phase away: what they cannot tell stays, however many trajectories there are.  Raw states
    keep everything, and have to learn from examples that a shifted window has the same parameters.  So magnitudes
    win where data are few, and raw states where data are many and the phase says something of the parameters.
    """
    for task in TASKS.values():
        config = training_config(task.name, settings.budget, settings.seed)
        for trajectories in FEATURE_TRAJECTORIES:
            known = replace(config, trajectories=trajectories)
            row: dict[str, Any] = {"task": "features", "method": f"{task.name} {trajectories}", "seed": settings.seed}
            for kind, features in (("magnitudes", log_magnitudes), ("raw", raw)):
                estimator = _labelled(task, known, features)
                for split, name in (("train", "PE_training"), ("test", "PE"), ("unseen", "PE_unseen")):
                    error = _parameter_error(estimator, draw_rollouts(task, known, split))
                    row[f"{name}_{kind}"] = float(f"{error:.4g}")
            yield row | {"updates": FEATURE_UPDATES, "batch": FEATURE_BATCH, "trajectories": trajectories}


def _labelled(task: Task, config: TrainingConfig, features: Features) -> AlpsEstimator:
    torch.manual_seed(config.seed)
    estimator = AlpsEstimator(task, NetworkConfig(), features)
    rollouts = draw_rollouts(task, config, "train")
    optimiser = torch.optim.Adam(estimator.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, FEATURE_UPDATES)
    for step in range(FEATURE_UPDATES):
        rows, starts = pick_windows(config, step, FEATURE_BATCH)
        error = (estimator(windows(rollouts.states, starts, rows)) - rollouts.parameters[rows]) / estimator.span
        optimiser.zero_grad()
        error.square().mean().backward()
        optimiser.step()
        schedule.step()
    return estimator


@torch.no_grad()
def _parameter_error(estimator: AlpsEstimator, rollouts: Rollouts) -> float:
    rows = torch.arange(len(rollouts.states))
    shown = windows(rollouts.states, rows % (ROLLOUT - WINDOW + 1), rows)
    return metrics.parameter_error(estimator(shown), rollouts.parameters)
