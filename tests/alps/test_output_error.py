"""Classical identification on pictures, the gauge-free figures, and the comparisons of the report."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from sprung.benchmarks import paper, paper_report, paper_settings, paper_sources
from sprung.model.alps import mass_spring_damper, metrics, output_error, pendulum, two_body
from sprung.model.alps.fit import Split
from sprung.model.alps.task import WINDOW, Task
from sprung.service.errors import UserError

EMBEDDING = 8


def split(task: Task, count: int, seed: int = 0, noise: float = 0.0) -> Split:
    rollouts = task.sample(count, np.random.default_rng(seed), task.seen)
    chart = task.to_chart(rollouts.states, task.placed)
    draw = torch.Generator().manual_seed(1)
    mix = torch.randn(chart.shape[-1], EMBEDDING, generator=draw, dtype=torch.float64)
    return Split(rollouts, (chart @ mix + noise * torch.randn(*chart.shape[:2], EMBEDDING, generator=draw)).float())


@pytest.mark.parametrize("task", [pendulum.TASK, mass_spring_damper.TASK, two_body.TASK], ids=lambda task: task.name)
def test_true_positions_give_the_true_parameters_and_states(task: Task) -> None:
    data = split(task, 3)
    true = data.rollouts.states[:, :WINDOW]
    found = output_error.fit_windows(task, true[..., task.placed], data.rollouts.inputs[:, :WINDOW])
    span = task.seen.high[0] - task.seen.low[0]
    error = (found.parameters - data.rollouts.parameters).abs().median() / span
    assert float(error) < 1e-3
    assert float(metrics.state_errors(task, found.simulated, true).median()) < 1e-3 * float(
        true.square().sum((1, 2)).median()
    )
    beyond = found.forecast(task, data.rollouts.inputs)[:, WINDOW:]  # what the window leads to
    after = data.rollouts.states[:, WINDOW:]
    assert float(metrics.state_errors(task, beyond, after).median()) < 0.01 * float(after.square().sum((1, 2)).median())


def test_a_pendulum_is_identified_from_an_affine_image_of_its_circle() -> None:
    task = pendulum.TASK
    data = split(task, 20)
    read = output_error.opened(task, data)(data.embeddings[:, :WINDOW])
    found = output_error.fit_windows(task, read, data.rollouts.inputs[:, :WINDOW])
    assert metrics.parameter_error(found.parameters, data.rollouts.parameters) < 0.05  # guessing the middle: 0.21


def test_known_inputs_open_a_driven_system() -> None:
    task = mass_spring_damper.TASK
    data = split(task, 16)
    untrained = output_error.opened(task, data)
    calibrated = output_error.calibrated(task, data)
    true = data.rollouts.states[..., task.placed]
    errors = [float((reading(data.embeddings) - true).square().mean().sqrt()) for reading in (untrained, calibrated)]
    assert errors[1] < 0.2 * errors[0]


def test_an_affine_image_of_the_states_scores_as_the_states() -> None:
    for task in (two_body.TASK, pendulum.TASK):
        true = split(task, 5).rollouts.states[:, :WINDOW]
        if task is two_body.TASK:
            seen = true @ torch.randn(8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 3
        else:
            seen = true * torch.tensor([-1.0, 0.3]) + torch.tensor([0.7, 0.0])  # turned, mirrored, scaled
        moved = metrics.affine_gauge(task, seen, true)(seen)
        assert metrics.relative_state_error(task, moved, true) < 1e-6
        assert metrics.explained(task, moved, true) == pytest.approx([1.0] * len(task.states), abs=1e-6)
        assert metrics.relative_state_error(task, seen, true) > 0.5


def test_comparisons_are_paired_and_separate_the_better_from_the_equal(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for seed in range(2):
        difficulty = rng.lognormal(0, 2, 60)  # trajectories differ far more than methods
        for method, factor in (("alps", 1.0), ("cdm", 1.5), ("no_attention", 1.0)):
            errors = difficulty * factor * rng.lognormal(0, 0.1, 60)
            np.savez(tmp_path / f"pendulum-{method}-s{seed}.npz", SE=errors)
    table = paper_report.comparisons("pendulum", tmp_path).splitlines()
    cells = {line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[2:]] for line in table[2:]}
    assert set(cells) == {"cdm", "no_attention"}
    assert float(cells["cdm"][2]) < 1e-6 and float(cells["no_attention"][2]) > 0.01
    assert cells["cdm"][1].startswith("1.") and cells["cdm"][4] == "-"


def test_rows_of_other_code_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "rows"
    folder.mkdir()
    row = {
        "task": "pendulum",
        "method": "alps",
        "SE": 1.0,
        "sources": paper_sources.sources("pendulum"),
        "commit": "abc",
    }
    (folder / "a.json").write_text(json.dumps(row))
    assert paper_report.read_rows(tmp_path) == [row]
    (folder / "b.json").write_text(json.dumps(row | {"method": "cdm", "sources": "older"}))
    with pytest.raises(ValueError, match="pendulum cdm"):
        paper_report.read_rows(tmp_path)


def test_several_methods_may_be_asked_for_at_once(tmp_path: Path) -> None:
    asked = partial(paper_settings.PaperSettings, "pendulum", budget="quick", seed=0, out=tmp_path, device="cpu")
    two = asked(method="cdm,alps", until=None)
    assert two.wants("cdm") and two.wants("alps") and not two.wants("zero")
    core = asked(method="core,hamiltonian", until=None)
    assert core.wants("zero") and core.wants("hamiltonian") and not core.wants("alps_plain")
    with pytest.raises(UserError, match="no method 'clever'"):
        next(paper.run("pendulum", method="alps,clever", out=tmp_path))


def test_rows_say_what_made_them() -> None:
    assert len(paper_sources.sources("pendulum")) == 12
    assert paper.commit()
