"""Training of the visual tasks: first the frame autoencoder, then each method on its embeddings.

Checkpoints, learning-rate schedule and seeding are those of `model.identification.amortised.training`: every update
draws from (seed, step), so that an interrupted run ends in the same weights as one that was not.  Tensors that come
from a file are copied, for the memory they are mapped to is not aligned like torch's own, and sums of the same numbers
then differ in their last bit.
"""

from __future__ import annotations

import copy
import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from sprung.model.alps.config import RECIPES, NetworkConfig, TrainingConfig, for_recipe
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.losses import loss_of, picture_loss, state_loss
from sprung.model.alps.network import Network
from sprung.model.alps.task import ROLLOUT, WINDOW, Rollouts, Task, windows
from sprung.model.identification.amortised.training import TrainingRun

_STREAMS = {"train": 0, "test": 1, "unseen": 2, "below": 3}


class OutOfTime(Exception):
    """The time allowed for this command is over; the checkpoint is saved and the same command goes on from it."""


@dataclass(frozen=True)
class TimeLimit:
    """Stops long runs between two updates."""

    until: float = float("inf")  # of time.monotonic()

    def check(self, run: TrainingRun) -> None:
        if time.monotonic() > self.until:
            run.save()
            raise OutOfTime(f"stopped at update {run.step}; run the same command again to go on")


@dataclass(frozen=True)
class Split:
    """Rollouts with the embedding of every frame."""

    rollouts: Rollouts
    embeddings: Tensor  # (R, T, E) float32


class VisualModel(nn.Module):
    """Frame autoencoder and the method's network: trained together where the budget allows."""

    def __init__(self, frames: FrameAutoencoder, network: Network) -> None:
        super().__init__()
        self.frames, self.network = frames, network


def draw_rollouts(task: Task, config: TrainingConfig, split: str) -> Rollouts:
    """The rollouts of a split: "train", "test", "unseen" (parameters above the range) or "below" it.

    The same for every method; another seed draws others.
    """
    rng = np.random.default_rng([7, _STREAMS[split], config.seed])
    count = config.trajectories if split == "train" else config.test_trajectories
    bounds = {"unseen": task.unseen, "below": task.below}.get(split, task.seen)
    return task.sample(count, rng, bounds)


def pick_windows(config: TrainingConfig, step: int, batch: int) -> tuple[Tensor, Tensor]:
    """Rows and starts (batch,) of the windows of an update."""
    rng = np.random.default_rng([config.seed, 3, step])
    rows = rng.integers(config.trajectories, size=batch)
    starts = rng.integers(ROLLOUT - WINDOW + 1, size=batch)
    return torch.from_numpy(rows), torch.from_numpy(starts)


def train_frames(
    task: Task, config: TrainingConfig, sizes: NetworkConfig, folder: Path, clock: TimeLimit, device: str = "cpu"
) -> FrameAutoencoder:
    """The frame autoencoder of a task, trained or from its checkpoint."""
    assert task.render is not None
    torch.manual_seed(config.seed)
    frames = FrameAutoencoder(sizes).to(device)
    states = draw_rollouts(task, config, "train").states.reshape(-1, len(task.states))

    def draw(count: int, *key: int) -> Tensor:
        pick = np.random.default_rng([config.seed, *key]).integers(len(states), size=count)
        return task.render(states[torch.from_numpy(pick)].to(device))  # type: ignore[misc]  # asserted above

    frames.standardise(draw(1000, 5), before=True)
    run = TrainingRun(frames, folder / "frames", config, _frames_name(task, config))
    run.resume()
    while run.step < config.frame_updates:
        clock.check(run)
        pictures = draw(config.frame_batch, 4, run.step)
        run.rate(config.frame_updates)
        run.update(picture_loss(frames(pictures), pictures))
        if run.step == config.frame_updates:
            frames.standardise(draw(1000, 5), before=False)
            run.save()
    drawing = TrainingRun(
        frames.draw, folder / "drawing", config, f"{_frames_name(task, config)} {config.drawing_updates}"
    )
    drawing.resume()
    while drawing.step < config.drawing_updates:
        clock.check(drawing)
        pictures = draw(config.frame_batch, 9, drawing.step)
        with torch.no_grad():
            embeddings = frames.encode(pictures)
        drawing.rate(config.drawing_updates)
        drawing.update(picture_loss(frames.decode(embeddings), pictures))
        if drawing.step == config.drawing_updates:
            drawing.save()
    return frames


def embedded(
    task: Task, config: TrainingConfig, frames: FrameAutoencoder, split: str, folder: Path, device: str = "cpu"
) -> Split:
    """A split with its embeddings, computed once and kept beside the checkpoints."""
    rollouts = draw_rollouts(task, config, split)
    path = folder / f"embeddings-{split}.safetensors"
    made_by = f"{_frames_name(task, config)} {len(rollouts.states)}"
    if path.is_file():
        with safe_open(path, framework="pt") as file:
            if (file.metadata() or {}).get("made_by") == made_by:
                return Split(rollouts, file.get_tensor("embeddings").clone())
    embeddings = frames.encode_rollouts(task, rollouts.states.to(device)).cpu()
    save_file({"embeddings": embeddings.contiguous()}, path, metadata={"made_by": made_by})
    return Split(rollouts, embeddings)


def new_model(
    task: Task, method: str, data: Split, frames: FrameAutoencoder, config: TrainingConfig, sizes: NetworkConfig,
    device: str = "cpu",
) -> VisualModel:  # fmt: skip
    """An untrained model of a method, opened on the training split where its recipe says so.

    Frames that are trained with the rest are the method's own: a copy.
    """
    torch.manual_seed(config.seed)
    recipe = RECIPES[method]
    drive = data.rollouts.inputs.square().mean((0, 1)).sqrt() if recipe.opening and task.inputs else None
    if config.end_to_end:
        frames = copy.deepcopy(frames)
    model = VisualModel(frames, Network(task, method, sizes, drive)).to(device)
    if recipe.opening:
        model.network.encoder.head.open_with_components(data.embeddings.flatten(0, 1)[::7].to(device))
    return model


def train_method(
    task: Task,
    method: str,
    data: Split,
    frames: FrameAutoencoder,
    config: TrainingConfig,
    sizes: NetworkConfig,
    folder: Path,
    clock: TimeLimit,
    device: str = "cpu",
) -> VisualModel:
    """One method of one task, trained or from its checkpoint."""
    config = for_recipe(config, RECIPES[method])
    model = new_model(task, method, data, frames, config, sizes, device)
    task = model.network.task  # in the recipe's units
    trained = model if config.end_to_end else model.network
    run = TrainingRun(trained, folder / f"{method}-s{config.seed}", config, _name(task, config, method))
    run.resume()
    model.train()
    encoded: Tensor | None = None  # only while the encoder rests
    while run.step < config.updates:
        clock.check(run)
        phase, rate = config.phase(run.step)
        run.optimiser.param_groups[0]["lr"] = rate
        torch.manual_seed(config.seed * 1_000_003 + run.step)
        if phase.trains == "estimator" and model.network.estimator is not None:
            encoded = _encode_all(task, model, data, config, device) if encoded is None else encoded
            run.update(_estimator_loss(task, model.network, encoded, data, config, run.step, device))
        else:
            encoded = None
            model.network.encoder.head.resting = phase.trains == "rates"
            run.update(_update_loss(task, model, data, config, run.step, device))
        if run.step == config.updates:
            run.save()
    return model.eval()


def _update_loss(task: Task, model: VisualModel, data: Split, config: TrainingConfig, step: int, device: str) -> Tensor:
    """The three-term loss on the windows of an update.

    What is to be drawn are the embeddings of the frame autoencoder as it was trained first, also where convolutions
    are trained with the rest: against embeddings that learn, too, the loss is smallest when all of them are the same.
    Pictures are drawn from simulated states as soon as these mean something; before, the decoder would learn to draw
    the mean picture.
    """
    phase, _ = config.phase(step)
    warm_up = phase.trains in ("rates", "states")
    rows, starts = pick_windows(config, step, config.batch)
    inputs = windows(data.rollouts.inputs, starts, rows).to(device)
    seen = embeddings = windows(data.embeddings, starts, rows).to(device)
    pictures = None
    if config.end_to_end:
        assert task.render is not None
        pictures = task.render(windows(data.rollouts.states, starts, rows).to(device).flatten(0, 1))
        seen = model.frames.encode(pictures).unflatten(0, (config.batch, WINDOW))
    passed = model.network(seen, inputs, phase.horizon, warm_up=warm_up)
    loss = loss_of(task, passed, embeddings, config, config.divergence(step)).total
    if pictures is not None and passed.observed is not None and not warm_up:
        loss = loss + config.pixel_weight * picture_loss(model.frames.decode(passed.observed.flatten(0, 1)), pictures)
    return loss


def _estimator_loss(
    task: Task, network: Network, encoded: Tensor, data: Split, config: TrainingConfig, step: int, device: str
) -> Tensor:
    """The state term alone, which is what reaches the estimator while the encoder rests; `encoded` by `_encode_all`."""
    phase, _ = config.phase(step)
    rows, starts = pick_windows(config, step, config.estimator_batch)
    states = encoded[rows.to(device), starts.to(device)]
    inputs = windows(data.rollouts.inputs, starts, rows).to(device)
    return state_loss(task, states, network.simulated(states, inputs, phase.horizon), config.outlier)


@torch.no_grad()
def _encode_all(task: Task, model: VisualModel, data: Split, config: TrainingConfig, device: str) -> Tensor:
    """Posterior means of every window by trajectory and start, (R, 26, WINDOW, N)."""
    embeddings = data.embeddings.to(device)
    if config.end_to_end:
        embeddings = model.frames.encode_rollouts(task, data.rollouts.states.to(device))
    starts = range(ROLLOUT - WINDOW + 1)
    return torch.stack([model.network.encoder(embeddings[:, at : at + WINDOW]).mean for at in starts], dim=1)


def seen_by(model: VisualModel, task: Task, split: Split, config: TrainingConfig) -> Split:
    """A split as a trained model's own convolutions see it; the split itself where they are the shared ones."""
    if not config.end_to_end:
        return split
    device = next(model.parameters()).device
    return replace(split, embeddings=model.frames.encode_rollouts(task, split.rollouts.states.to(device)).cpu())


def _frames_name(task: Task, config: TrainingConfig) -> str:
    """What the frame autoencoder depends on; the methods' settings are none of it."""
    used = (config.seed, config.trajectories, config.learning_rate, config.frame_updates, config.frame_batch)
    return f"{task.name} frames {used}"


def _name(task: Task, config: TrainingConfig, what: str) -> str:
    return f"{task.name} {what} " + json.dumps(asdict(config), sort_keys=True)
