"""`sprung bench paper poor_opening`: what classical identification and ALPS make of an opening that is wrong.

Both read positions from a picture's embedding by an affine map that the task's opening starts (`Task.opening`), and
improve it.  Here that start is mixed with a random one: a share of 0 leaves it, a share of 1 leaves nothing of it.
The random one is drawn from the seed and the same for both methods; so are data, embeddings and the windows judged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sprung.benchmarks.paper_data import TaskData, data_of
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import evaluate, metrics, output_error, pendulum
from sprung.model.alps.config import RECIPES, NetworkConfig, for_recipe
from sprung.model.alps.evaluate import Predicted
from sprung.model.alps.fit import Split, train_method
from sprung.model.alps.task import ROLLOUT, WINDOW, Task, windows

TASKS = (pendulum.TASK,)  # of those that have an opening: classical identification is quick there
SHARES = (0.5, 1.0)  # of the opening that is random
METHODS = ("output_error", "alps")
_GAUGE_WINDOWS = 200  # labelled training windows for the affine gauge, the same for both

Answer = Callable[[Split, Tensor, Tensor], Predicted]  # windows of a split by their rows and starts


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per system, share and method: SE after the affine map, PE."""
    for known in TASKS:
        data = data_of(known, settings, settings.seed)
        for share in SHARES:
            task = spoilt(known, share, settings.seed)
            for method in METHODS:
                if not settings.wants(method):
                    continue
                begin = time.process_time()
                used: dict[str, Any] = {}
                if method == "alps":
                    answer = _trained(task, data, settings, f"{known.name}-{share:g}")
                    used = asdict(for_recipe(data.config, RECIPES[method])) | asdict(RECIPES[method])
                else:
                    answer = _fitted(task, data)
                figures = {name: float(f"{value:.4g}") for name, value in _figures(known, answer, data).items()}
                yield {
                    "task": settings.task, "method": f"{known.name} {share:g} {method}", **figures, "share": share,
                    "seed": settings.seed, "budget": settings.budget, "settings": used,
                    "processor_seconds": round(time.process_time() - begin, 1),
                }  # fmt: skip


def spoilt(task: Task, share: float, seed: int) -> Task:
    """The task with a share of its opening's weights and offsets drawn at random, in units of the components' size."""
    known = task.opening
    assert known is not None
    draw = np.random.default_rng([12, seed])
    count = len(task.placed) + len(set(task.placed) & set(task.angles))  # an angle has sine and cosine
    random_weights, random_offsets = (torch.from_numpy(draw.standard_normal(size)) for size in ((count, 2), (count,)))

    def opening(components: Tensor) -> tuple[Tensor, Tensor]:
        weights, offsets = known(components)
        return (1 - share) * weights + share * random_weights, (1 - share) * offsets + share * random_offsets

    return replace(task, opening=opening)


def _trained(task: Task, data: TaskData, settings: PaperSettings, name: str) -> Answer:
    """ALPS that starts from the opening that `task` has."""
    folder = settings.folder / name
    folder.mkdir(exist_ok=True)
    model = train_method(
        task, "alps", data.train, data.frames, data.config, NetworkConfig(), folder, settings.clock, settings.device
    )
    return lambda split, rows, starts: evaluate.predict(model, split, rows, starts, lambda states: states)


def _fitted(task: Task, data: TaskData) -> Answer:
    """Output error that starts from the opening that `task` has."""
    reading = output_error.calibrated(task, data.train)

    def answer(split: Split, rows: Tensor, starts: Tensor) -> Predicted:
        read = reading(windows(split.embeddings, starts, rows))
        found = output_error.fit_windows(task, read, windows(split.rollouts.inputs, starts, rows))
        return Predicted(
            windows(split.rollouts.states, starts, rows), output_error.differences(task, read), found.simulated, None,
            found.parameters, split.rollouts.parameters[rows],
        )  # fmt: skip

    return answer


def _figures(task: Task, answer: Answer, data: TaskData) -> dict[str, float]:
    """SE after an affine map fitted on training windows, and PE, on one window of every test trajectory."""
    rows = torch.arange(min(_GAUGE_WINDOWS, len(data.train.embeddings)))
    like = answer(data.train, rows, rows % (ROLLOUT - WINDOW + 1))
    move = metrics.affine_gauge(task, like.simulated, like.true)
    rows = torch.arange(len(data.test.embeddings))
    found = answer(data.test, rows, rows % (ROLLOUT - WINDOW + 1))
    assert found.parameters is not None
    return {
        "SE_affine": metrics.state_error(task, move(found.simulated), found.true),
        "SE_affine_relative": metrics.relative_state_error(task, move(found.simulated), found.true),
        "PE": metrics.parameter_error(found.parameters, found.true_parameters),
        "PE_relative": metrics.relative_parameter_error(found.parameters, found.true_parameters),
    }
