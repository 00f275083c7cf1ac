"""Openings that are wrong: what is drawn, and what classical identification makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sprung.benchmarks import paper, poor_opening
from sprung.benchmarks.paper_data import TaskData
from sprung.model.alps import pendulum
from sprung.model.alps.config import training_config
from sprung.model.alps.fit import Split


def test_a_share_of_the_opening_is_random_and_the_seed_says_which() -> None:
    task = pendulum.TASK
    angle = torch.linspace(0, 6, 200, dtype=torch.float64)
    components = torch.stack([torch.sin(angle), torch.cos(angle)], dim=1)

    def opened(share: float, seed: int) -> torch.Tensor:
        opening = poor_opening.spoilt(task, share, seed).opening
        assert opening is not None
        return torch.cat([part.flatten() for part in opening(components)])

    assert task.opening is not None
    right = torch.cat([part.flatten() for part in task.opening(components)])
    torch.testing.assert_close(opened(0, 1), right)
    torch.testing.assert_close(opened(0.5, 1), opened(0.5, 1))
    assert not torch.allclose(opened(0.5, 1), opened(0.5, 2))
    torch.testing.assert_close(opened(0.5, 1), 0.5 * right + 0.5 * opened(1, 1))


@pytest.mark.slow
def test_rows_name_system_share_and_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = pendulum.TASK
    rollouts = task.sample(4, np.random.default_rng(0), task.seen)
    angle = rollouts.states[..., 0]
    seen = Split(rollouts, torch.stack([torch.sin(angle), torch.cos(angle)], dim=-1).float())
    config = training_config("pendulum", "quick", 0)
    data = TaskData(config, None, seen, seen)  # type: ignore[arg-type]
    monkeypatch.setattr(poor_opening, "data_of", lambda *_: data)
    monkeypatch.setattr(poor_opening, "SHARES", (0.0, 1.0))
    right, wrong = paper.run("poor_opening", method="output_error", out=tmp_path)
    assert (right["method"], wrong["method"]) == ("pendulum 0 output_error", "pendulum 1 output_error")
    assert right["PE"] < 0.01 and wrong["PE"] > 3 * right["PE"]
    assert right["seed"] == 0 and right["share"] == 0
