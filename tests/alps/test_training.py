"""Training of the paper's networks: resume, the train system, the benchmark's door."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sprung.benchmarks import paper, physics_overhead
from sprung.benchmarks.bounds import shared_bound
from sprung.benchmarks.physics_overhead import stepwise
from sprung.model.alps import fit, mass_spring_damper, pendulum, train_fit, two_body
from sprung.model.alps.config import NetworkConfig, Phase, TrainingConfig, training_config
from sprung.model.alps.evaluate import every_window, predict, state_figures, symmetry
from sprung.model.alps.fit import OutOfTime, Split, TimeLimit
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.losses import tempered
from sprung.model.alps.network import Network
from sprung.model.alps.task import WINDOW, Task
from sprung.model.alps.train_system import (
    TrainData,
    full_state_system,
    generate,
    smoothed,
    to_points,
    to_states,
    train_task,
)
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import load_system
from sprung.service.errors import UserError

SIZES = NetworkConfig()
TINY = TrainingConfig(
    phases=(
        Phase("states", 9, 2, (2e-3, 2e-3)),
        Phase("estimator", 33, 2, (2e-3, 1e-3)),
        Phase("all", 99, 2, (1e-3, 0)),
    ),
    trajectories=6,
    test_trajectories=3,
    batch=2,
    estimator_batch=4,
    checkpoint_every=2,
    frame_updates=4,
    drawing_updates=4,
    frame_batch=8,
)


@pytest.fixture(scope="module")
def train_data() -> TrainData:
    return generate(True, np.random.default_rng(0), 4)


def fake_split() -> Split:
    """Embeddings that are an affine image of the positions, as feature points nearly are."""
    task = two_body.TASK
    rollouts = fit.draw_rollouts(task, TINY, "train")
    mix = torch.randn(4, SIZES.embedding, generator=torch.Generator().manual_seed(0))
    return Split(rollouts, task.to_chart(rollouts.states, task.placed).float() @ mix)


@pytest.mark.parametrize("end_to_end", [False, True])
def test_an_interrupted_run_ends_in_the_same_weights(tmp_path: Path, end_to_end: bool) -> None:
    task, data, config = two_body.TASK, fake_split(), replace(TINY, end_to_end=end_to_end)
    torch.manual_seed(0)
    frames = FrameAutoencoder(SIZES)
    first = next(frames.embed.maps.parameters()).detach().clone()

    def trained(folder: Path) -> list[torch.Tensor]:
        folder.mkdir(exist_ok=True)
        model = fit.train_method(task, "alps", data, frames, config, SIZES, folder, TimeLimit())
        assert torch.equal(next(model.frames.embed.maps.parameters()), first) is not end_to_end
        return [p.detach().clone() for p in model.parameters()]

    straight = trained(tmp_path / "straight")
    folder = tmp_path / "broken"
    folder.mkdir()

    class Stops(TimeLimit):
        def check(self, run: Any) -> None:
            if run.step == 3:
                run.save()
                raise OutOfTime("stopped")

    with pytest.raises(OutOfTime):
        fit.train_method(task, "alps", data, frames, config, SIZES, folder, Stops())
    for left, right in zip(straight, trained(folder), strict=True):
        torch.testing.assert_close(left, right)


def test_the_frame_autoencoder_learns_and_is_kept(tmp_path: Path) -> None:
    task = mass_spring_damper.TASK
    config = replace(TINY, frame_updates=12, learning_rate=5e-3)
    frames = fit.train_frames(task, config, SIZES, tmp_path, TimeLimit())
    assert task.render is not None
    pictures = task.render(fit.draw_rollouts(task, config, "test").states[:, 60])
    untrained = FrameAutoencoder(SIZES)
    with torch.no_grad():
        error = (frames(pictures) - pictures).square().mean()
        assert float(error) < 0.9 * float((untrained(pictures) - pictures).square().mean())
        embeddings = frames.encode(task.render(fit.draw_rollouts(task, config, "train").states[:, ::5].flatten(0, 1)))
        assert float((embeddings.std(0) - 1).abs().max()) < 0.3
        torch.testing.assert_close(frames.decode(frames.encode(pictures)), frames(pictures), atol=1e-4, rtol=1e-3)
    again = fit.train_frames(task, config, SIZES, tmp_path, TimeLimit(until=0.0))  # no time left, none needed
    torch.testing.assert_close(again.outer, frames.outer)


def test_opening_with_components_finds_the_orbits_up_to_their_turn() -> None:
    task = two_body.TASK
    torch.manual_seed(0)
    data = fake_split()
    model = fit.VisualModel(FrameAutoencoder(SIZES), Network(task, "alps", SIZES)).eval()
    rows, starts = every_window(data)
    model.network.encoder.head.open_with_components(data.embeddings.flatten(0, 1))
    opened = predict(model, data, rows[:20], starts[:20], symmetry(task, model, data))
    error = (opened.encoded - opened.true)[..., :4].square().mean().sqrt()
    assert float(error) < 0.6 * float(opened.true[..., :4].square().mean().sqrt())
    figures = state_figures(task, opened)
    assert figures["PE"] is not None and figures["SE"] is not None


def test_schedules_lengthen_the_horizon_and_the_prior_fades() -> None:
    for name in ("pendulum", "mass_spring_damper", "two_body"):
        config = training_config(name, "quick", 0)
        horizons = [phase.horizon for phase in config.phases]
        assert horizons == sorted(horizons) and horizons[-1] == 99
        assert all(99 % horizon == 0 for horizon in horizons)
        assert config.divergence(config.updates) == pytest.approx(config.divergence_weight)
        assert training_config(name, "full", 0).end_to_end


def test_phases_follow_each_other_with_their_learning_rates() -> None:
    found = [TINY.phase(step) for step in range(TINY.updates)]
    assert [phase.trains for phase, _ in found] == ["states", "states", "estimator", "estimator", "all", "all"]
    assert [rate for _, rate in found] == pytest.approx([2e-3, 2e-3, 2e-3, 1.5e-3, 1e-3, 0.5e-3])


def test_only_the_estimator_moves_while_the_encoder_rests(tmp_path: Path) -> None:
    task, frames = two_body.TASK, FrameAutoencoder(SIZES)
    before = fit.train_method(
        task, "alps", fake_split(), frames, replace(TINY, phases=TINY.phases[:1]), SIZES, tmp_path, TimeLimit()
    )
    path = tmp_path / "longer"
    path.mkdir()
    after = fit.train_method(
        task, "alps", fake_split(), frames, replace(TINY, phases=TINY.phases[:2]), SIZES, path, TimeLimit()
    )
    for (name, left), right in zip(before.network.named_parameters(), after.network.parameters(), strict=True):
        if not name.startswith("estimator"):
            torch.testing.assert_close(left, right)
    assert before.network.estimator is not None and after.network.estimator is not None
    pairs = zip(before.network.estimator.parameters(), after.network.estimator.parameters(), strict=True)
    assert any(not torch.equal(left, right) for left, right in pairs)


def test_a_lost_simulation_counts_little() -> None:
    squared = torch.tensor([[1e-4, 0.1, 10.0]])
    small, knee, lost = (float(tempered(squared[:, i : i + 1], 0.1)) for i in range(3))
    assert small == pytest.approx(1e-4, rel=1e-3)
    assert knee == pytest.approx(0.1 * np.log(2))
    assert lost < 0.5


def test_train_trajectories_have_the_papers_sizes(train_data: TrainData) -> None:
    assert train_data.measured.shape == (4, 500, 18)
    assert train_data.observations.shape == (4, 500, 12)
    assert train_data.known.shape == (4, 500, 16)
    assert train_data.log_ratio.shape == (4, 24)
    constant = generate(False, np.random.default_rng(0), 3).log_ratio
    assert bool((constant == constant[0]).all()) and not bool(
        (train_data.log_ratio[0] == train_data.log_ratio[1]).all()
    )


def test_true_states_are_what_the_simulator_gives_from_their_first(train_data: TrainData) -> None:
    task = train_task(train_data)
    path = task.simulate(train_data.states[:, 0], train_data.log_ratio, train_data.known)
    error = (path - train_data.states).square().mean((0, 1)).sqrt() / train_data.size
    assert float(error.max()) < 0.01


def test_measured_states_have_one_percent_noise(train_data: TrainData) -> None:
    ratio = (train_data.measured - train_data.states).std((0, 1)) / train_data.size
    np.testing.assert_allclose(ratio.numpy(), 0.01, rtol=0.1)


def test_points_and_states_are_two_views_of_the_same_motion(train_data: TrainData) -> None:
    states = train_data.states.numpy()
    np.testing.assert_allclose(to_states(to_points(states)), states, atol=1e-12)


def test_refinement_from_states_reaches_its_bound_from_the_nominal_values(train_data: TrainData) -> None:
    system = full_state_system(load_system(), train_data.noise.numpy())
    measured = np.concatenate([train_data.known.numpy(), to_points(train_data.measured.numpy())], axis=2)[:, :100]
    found = Refiner(system).refine(measured)
    error = found.log_ratio - train_data.log_ratio.numpy()
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert bool(found.converged.all())
    assert 0.7 < float(np.sqrt(((error / std) ** 2).mean())) < 1.4
    assert float(np.abs(error).mean()) < 0.006


def test_a_start_from_the_whole_window_carries_less_noise_than_its_first_sample(train_data: TrainData) -> None:
    system = load_system()
    simulator = LinearSimulator(system)
    measured, known = train_data.measured[:, :100], train_data.known[:, :100]
    truth = train_data.log_ratio.clone().requires_grad_()
    best = smoothed(simulator, truth, measured, known, train_data.noise)
    first = simulator.simulate(train_data.log_ratio, known, measured[:, 0])[1]

    def error(path: torch.Tensor) -> float:
        return float(((path - train_data.states[:, :100]) / train_data.size).detach().square().mean().sqrt())

    assert error(best) < 0.3 * error(first)
    misfit = ((best - measured) / train_data.noise).square().sum()
    (slope,) = torch.autograd.grad(misfit, truth)
    step = torch.zeros_like(train_data.log_ratio)
    step[:, 3] = 1e-4

    def moved(sign: int) -> torch.Tensor:
        path = smoothed(simulator, train_data.log_ratio + sign * step, measured, known, train_data.noise)
        return ((path - measured) / train_data.noise).square().sum((1, 2))

    torch.testing.assert_close(slope[:, 3], (moved(1) - moved(-1)) / 2e-4, rtol=1e-3, atol=0.1)


def test_the_papers_estimator_finds_constant_parameters_without_labels(tmp_path: Path) -> None:
    data = generate(False, np.random.default_rng(1), 6)
    config = train_fit.TrainConfig(updates=25, batch=8, checkpoint_every=50)
    model = train_fit.fit("alps", data, config, tmp_path, TimeLimit(), "test")
    figures = train_fit.figures(model, data, hop=100)
    untrained = train_fit.figures(train_fit.build("alps", data), data, hop=100)
    for quantity, share in (("PE_relative", 0.35), ("SE", 0.2)):
        ours, theirs = figures[quantity], untrained[quantity]
        assert ours is not None and theirs is not None and ours < share * theirs


@pytest.mark.parametrize("method", ["cdm", "alps_smoothed", "alps_from_sensors", "alps_known_sensors", "no_fourier"])
def test_every_train_method_takes_a_step(method: Any, tmp_path: Path, train_data: TrainData) -> None:
    config = train_fit.TrainConfig(updates=2, batch=2, checkpoint_every=50)
    model = train_fit.fit(method, train_data, config, tmp_path, TimeLimit(), "test")
    figures = train_fit.figures(model, train_data, hop=200)
    assert figures["SE"] is not None and np.isfinite(figures["SE"])


def test_the_readout_is_the_best_map_and_its_gradient_that_of_what_no_map_explains() -> None:
    draw = torch.Generator().manual_seed(0)
    seen = torch.randn(2, 40, 4, generator=draw, dtype=torch.float64).requires_grad_()
    shown = torch.randn(2, 40, 3, generator=draw, dtype=torch.float64)
    readout = train_fit.Readout(4, 3)

    def left(x: torch.Tensor) -> torch.Tensor:
        return (readout(x, shown) - shown).square().sum()

    best = np.linalg.lstsq(seen.detach().flatten(0, 1).numpy(), shown.flatten(0, 1).numpy(), rcond=None)
    assert left(seen).item() == pytest.approx(best[1].sum(), rel=1e-6)
    assert torch.autograd.gradcheck(left, (seen,), rtol=1e-3, atol=1e-4)
    kept = readout.eval()(torch.eye(4, dtype=torch.float64)[None], shown)
    torch.testing.assert_close(kept[0], torch.from_numpy(best[0]), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("task", [mass_spring_damper.TASK, pendulum.TASK, two_body.TASK], ids=lambda task: task.name)
def test_torchdiffeq_and_our_solutions_agree(task: Task) -> None:
    drawn = task.sample(2, np.random.default_rng(0), task.seen)
    args = drawn.states[:, 0], drawn.parameters, drawn.inputs[:, :30]
    ours = task.simulate(*args)
    for method, tolerance in (("dopri5", 1e-3), ("rk4", 0.03)):
        error = task.difference(stepwise(task, method).simulate(*args), ours) / torch.tensor(task.state_scale)
        assert float(error.abs().max()) < tolerance


@pytest.mark.slow
def test_what_physics_costs_is_measured_for_the_train_too() -> None:
    rows = list(physics_overhead.run("quick", system="train", batch=2))
    assert [row["method"] for row in rows] == [
        "autoencoder",
        "alps_torchdiffeq_dopri5",
        "alps_torchdiffeq_rk4",
        "alps_ours",
    ]
    assert rows[0]["over_autoencoder"] == 0 and all(row["seconds_per_update"] > 0 for row in rows)
    with pytest.raises(UserError, match="trian"):
        next(physics_overhead.run("quick", system="trian"))


def test_the_bench_says_what_it_does_not_know() -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"task": "penduluum"}, "penduluum"),
        ({"task": "pendulum", "method": "greybox"}, "greybox"),
        ({"task": "pendulum", "budget": "huge"}, "huge"),
        ({"task": "pendulum", "device": "cuda:9" if not torch.cuda.is_available() else "tpu"}, "device"),
    ]
    for arguments, word in wrong:
        with pytest.raises(UserError, match=word):
            next(paper.run(**arguments))


def test_the_bench_gives_the_kernels_and_their_picture(tmp_path: Path) -> None:
    rows = list(paper.run("kernels", out=tmp_path))
    assert [row["method"] for row in rows] == ["none", "k_DFT", "k_MAG", "k_PHA"]
    assert all(row["commit"] and row["sources"] and "torch" in row["arithmetic"] for row in rows)
    assert (tmp_path / "quick" / "pictures" / "kernels.png").is_file()


def test_a_bench_without_time_says_how_to_go_on(tmp_path: Path) -> None:
    (row,) = list(paper.run("pendulum", method="alps", out=tmp_path, minutes=0.0))
    assert "run the same command again" in row["unfinished"]


def test_positions_rest_as_opened_while_rates_are_learned(tmp_path: Path) -> None:
    task, data, frames = two_body.TASK, fake_split(), FrameAutoencoder(SIZES)
    config = replace(TINY, phases=(Phase("rates", 9, 2, (2e-3, 2e-3)),))
    trained = fit.train_method(task, "alps", data, frames, config, SIZES, tmp_path, TimeLimit()).network.encoder
    torch.manual_seed(config.seed)
    opened = Network(task, "alps", SIZES).encoder
    opened.head.open_with_components(data.embeddings.flatten(0, 1)[::7])
    seen = data.embeddings[:, :WINDOW]
    torch.testing.assert_close(trained(seen).mean[..., :4], opened(seen).mean[..., :4])
    moved = (trained(seen).mean - opened(seen).mean)[..., 4:]
    assert float(moved.detach().abs().max()) > 1e-4


def test_the_bound_falls_with_windows_and_rises_where_the_sensors_are_unknown(train_data: TrainData) -> None:
    system, truth = load_system(), train_data.log_ratio[0]
    windows = [values[0].unflatten(0, (5, 100)) for values in (train_data.states, train_data.known)]
    one = shared_bound(system, truth, *[w[:1] for w in windows], free=False)
    twice = shared_bound(system, truth, *[w[[0, 0]] for w in windows], free=False)
    np.testing.assert_allclose(twice, one / np.sqrt(2), rtol=1e-6)
    known, unknown = (shared_bound(system, truth, *windows, free=free) for free in (False, True))
    assert (known < one).all() and (known < unknown * (1 + 1e-6)).all()
