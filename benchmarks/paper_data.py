"""Data and embeddings of a visual task for one seed, that experiments beside the paper's tables share with these."""

from __future__ import annotations

from dataclasses import dataclass

from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps.config import NetworkConfig, TrainingConfig, training_config
from sprung.model.alps.fit import Split, embedded, train_frames
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.task import Task


@dataclass(frozen=True)
class TaskData:
    """What the methods of a task share for one seed."""

    config: TrainingConfig
    frames: FrameAutoencoder
    train: Split
    test: Split


def data_of(task: Task, settings: PaperSettings, seed: int) -> TaskData:
    """Data and embeddings as the task's own rows have them, from their checkpoints where these were made."""
    config = training_config(task.name, settings.budget, seed)
    folder = settings.out / settings.budget / task.name / f"seed-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    frames = train_frames(task, config, NetworkConfig(), folder, settings.clock, settings.device)
    train, test = (embedded(task, config, frames, name, folder, settings.device) for name in ("train", "test"))
    return TaskData(config, frames, train, test)
