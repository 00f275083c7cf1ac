"""Methods with settings of their own: what a trial changes, which one is taken, and what the page says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sprung.benchmarks import paper, tuning
from sprung.benchmarks.paper_report.tuned import tuned_table
from sprung.model.alps import pendulum
from sprung.model.alps.config import training_config
from sprung.model.alps.task import Task


def test_a_trial_changes_what_it_says_and_nothing_else() -> None:
    config = training_config("two_body", "quick", 0)
    rates = tuning.TRIALS["cdm"]["rates x 2.5"](config)
    for before, after in zip(config.phases, rates.phases, strict=True):
        assert after.learning_rate == (2.5 * before.learning_rate[0], 2.5 * before.learning_rate[1])
        assert (after.trains, after.horizon, after.updates) == (before.trains, before.horizon, before.updates)
    prior = tuning.TRIALS["autoencoder"]["prior x 0.1"](config)
    assert prior.divergence(0) == pytest.approx(0.1 * config.divergence(0))
    assert prior.divergence(10_000) == pytest.approx(0.1 * config.divergence(10_000))
    dynamics = tuning.TRIALS["cdm"]["dynamics x 5"](config)
    assert dynamics.state_weight == 5 * config.state_weight
    assert all(trials["as alps"](config) == config for trials in tuning.TRIALS.values())


@pytest.mark.parametrize(("errors", "tuned"), [((3.0, 2.0, 4.0), "rates x 0.4"), ((1.0, 2.0, 4.0), None)])
def test_the_best_trial_is_trained_on_every_seed_where_it_beats_the_settings_of_alps(
    errors: tuple[float, float, float], tuned: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_trial = dict(zip(("as alps", "rates x 0.4", "rates x 2.5"), errors, strict=True))
    trained: list[tuple[str, int]] = []

    def row(task: Task, method: str, trial: str, settings: Any, seed: int, name: str) -> dict[str, Any]:
        trained.append((trial, seed))
        return {"task": settings.task, "method": name, "SE_affine": of_trial[trial], "trial": trial, "seed": seed}

    monkeypatch.setattr(tuning, "_row", row)
    monkeypatch.setattr(tuning, "TASKS", (pendulum.TASK,))
    monkeypatch.setattr(tuning, "TRIALS", {"cdm": dict.fromkeys(of_trial)})
    rows = list(paper.run("tuning", method="cdm", seeds=2, out=tmp_path))
    search = [(trial, tuning.SEARCH_SEED) for trial in of_trial]  # made once
    assert trained == ([*search, (tuned, 0), (tuned, 1)] if tuned else search)
    assert [one["method"] for one in rows[:3]] == [f"pendulum cdm, {trial}" for trial in of_trial]
    assert [(one["method"], one["seed"]) for one in rows[3:]] == (
        [("pendulum cdm tuned", 0), ("pendulum cdm tuned", 1)] if tuned else []
    )


def test_the_page_holds_what_was_found_against_the_method_itself_and_against_alps_tuned_and_not() -> None:
    def row(task: str, method: str, error: float, seed: int, trial: str = "") -> dict[str, Any]:
        return {"task": task, "method": method, "SE_affine": error, "seed": seed, "trial": trial}

    rows = [
        row("tuning", "pendulum cdm, as alps", 4.0, 5, "as alps"),
        row("tuning", "pendulum cdm, rates x 0.4", 2.0, 5, "rates x 0.4"),
        row("tuning", "pendulum alps, as alps", 2.0, 5, "as alps"),
        row("tuning", "pendulum alps, prior x 10", 1.0, 5, "prior x 10"),
        *(row("tuning", "pendulum cdm tuned", error, seed, "rates x 0.4") for seed, error in enumerate((3.0, 5.0))),
        *(row("tuning", "pendulum alps tuned", 1.0, seed, "prior x 10") for seed in (0, 1)),
        *(row("pendulum", "cdm", 8.0, seed) for seed in (0, 1)),
        *(row("pendulum", "alps", 2.0, seed) for seed in (0, 1)),
        row("tuning", "two_body cdm, as alps", 4.0, 5, "as alps"),
        row("tuning", "two_body cdm, rates x 0.4", 6.0, 5, "rates x 0.4"),
        {"task": "tuning", "method": "pendulum cdm tuned", "trial": "rates x 0.4", "seed": 2, "diverged": "lower"},
        {"task": "tuning", "method": "two_body cdm, rates x 2.5", "trial": "rates x 2.5", "seed": 5, "diverged": "x"},
        row("two_body", "cdm", 8.0, 0),
        row("two_body", "alps", 2.0, 0),
    ]
    lines = tuned_table(rows).splitlines()[2:]
    assert lines == [
        "| pendulum | cdm | rates x 0.4 0.5 | 0.5 | 2 | 4 | 3, 5; diverged on seed 2 | 0.12 |",
        "| pendulum | alps | prior x 10 0.5 | 0.5 | - | - | - | - |",
        "| two_body | cdm | rates x 0.4 1.5, rates x 2.5 inf | - | 4 | 4 | 4 | - |",
    ]
