"""Methods of the paper and their recipes: what each leaves out, end-to-end training, repeatability."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sprung.model.alps import fit, mass_spring_damper, pendulum, two_body
from sprung.model.alps.config import METHODS, RECIPES, NetworkConfig, Phase, TrainingConfig, for_recipe
from sprung.model.alps.fit import Split, TimeLimit
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.hamiltonian import HamiltonianDynamics
from sprung.model.alps.losses import spread_loss, tempered
from sprung.model.alps.network import Network
from sprung.model.alps.task import WINDOW, Task

SIZES = NetworkConfig()
TINY = TrainingConfig(
    phases=(
        Phase("states", 9, 1, (2e-3, 2e-3)), Phase("estimator", 33, 1, (2e-3, 1e-3)), Phase("all", 99, 1, (1e-3, 0)),
    ),
    trajectories=6, test_trajectories=3, batch=2, estimator_batch=4, checkpoint_every=2, frame_updates=4,
    drawing_updates=4, frame_batch=8,
)  # fmt: skip


def split(task: Task) -> Split:
    """Embeddings that are an affine image of the positions, as feature points nearly are."""
    rollouts = fit.draw_rollouts(task, TINY, "train")
    chart = task.to_chart(rollouts.states, task.placed).float()
    mix = torch.randn(chart.shape[-1], SIZES.embedding, generator=torch.Generator().manual_seed(0))
    return Split(rollouts, chart @ mix)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_on_a_driven_and_on_a_turning_system(method: str, tmp_path: Path) -> None:
    for task in (mass_spring_damper.TASK, pendulum.TASK):
        model = fit.train_method(task, method, split(task), FrameAutoencoder(SIZES), TINY, SIZES, tmp_path, TimeLimit())
        for name, weight in model.network.named_parameters():
            assert torch.isfinite(weight).all(), (task.name, name)


@pytest.mark.parametrize("method", METHODS)
def test_no_method_makes_tensors_on_another_device_than_its_own(method: str) -> None:
    for task in (mass_spring_damper.TASK, two_body.TASK):  # a von Mises posterior asks its values, which meta has not
        network = Network(task, method, SIZES).to("meta").eval()
        inputs = torch.zeros(2, WINDOW, task.inputs, dtype=torch.float64, device="meta")
        passed = network(torch.zeros(2, WINDOW, SIZES.embedding, device="meta"), inputs, 9)
        assert passed.simulated.device.type == "meta"


def test_leave_one_out_recipes_leave_out_one_thing() -> None:
    fields = ("straight", "opening", "positions_shown", "phased", "tempered", "falling_prior")
    helped = RECIPES["alps"]
    left_out = {
        tuple(f for f in fields if getattr(RECIPES[m], f) != getattr(helped, f))
        for m in METHODS
        if (m.startswith("no_") and m not in ("no_fourier", "no_attention")) or m == "all_states_shown"
    }
    assert left_out == {(field,) for field in fields}
    assert all(getattr(RECIPES["alps_plain"], field) is False for field in fields)
    for baseline in ("cdm", "hamiltonian"):  # the same help as alps
        assert all(getattr(RECIPES[baseline], field) for field in fields)


def test_the_plain_recipe_trains_as_printed() -> None:
    plain = for_recipe(TINY, RECIPES["alps_plain"])
    assert [phase.trains for phase in plain.phases] == ["all"] and plain.phases[0].horizon == WINDOW - 1
    assert plain.updates == TINY.updates
    assert plain.divergence(0) == plain.divergence(10_000) == TINY.divergence_weight
    squared = torch.tensor([[0.5, 4.0]])
    assert math.isclose(float(tempered(squared, plain.outlier)), 2.25)
    assert for_recipe(TINY, RECIPES["alps"]) == TINY


def test_scales_are_taken_by_the_recipe() -> None:
    network = Network(two_body.TASK, "scales_doubled", SIZES)
    assert network.task.state_scale == tuple(2 * size for size in two_body.TASK.state_scale)
    assert network.encoder.head.scales == list(network.task.state_scale)


def test_convolutions_trained_end_to_end_are_the_methods_own_and_are_used_for_its_figures(tmp_path: Path) -> None:
    task = mass_spring_damper.TASK
    config = replace(TINY, phases=(Phase("all", 99, 2, (1e-2, 1e-2)),), end_to_end=True)
    shared = FrameAutoencoder(SIZES)
    before = [p.detach().clone() for p in shared.parameters()]
    rollouts = fit.draw_rollouts(task, config, "train")
    data = Split(rollouts, shared.encode_rollouts(task, rollouts.states))
    model = fit.train_method(task, "alps", data, shared, config, SIZES, tmp_path, TimeLimit())
    for old, now in zip(before, shared.parameters(), strict=True):
        assert torch.equal(old, now)  # the next method starts from the same
    seen = fit.seen_by(model, task, data, config)
    moved = float((seen.embeddings - data.embeddings).square().mean().sqrt())
    assert moved > 0.01
    assert task.render is not None
    with torch.no_grad():
        torch.testing.assert_close(model.frames.encode(task.render(rollouts.states[0])), seen.embeddings[0])
    assert fit.seen_by(model, task, data, TINY) is data


def test_convolutions_that_see_nothing_are_no_way_to_a_small_loss() -> None:
    task, frames = two_body.TASK, FrameAutoencoder(SIZES)
    config = replace(
        TINY, end_to_end=True, state_weight=0, pixel_weight=0, divergence_start=1e-9, divergence_weight=1e-9
    )
    data = split(task)
    model = fit.new_model(task, "cdm", data, frames, config, SIZES)
    assert model.network.decoder is not None
    for module in (model.frames.embed.maps, model.network.decoder):
        for weight in module.parameters():
            torch.nn.init.zeros_(weight)  # every embedding the same, and that one drawn
    with torch.no_grad():
        model.network.decoder.affine.bias.copy_(fit.seen_by(model, task, data, config).embeddings[0, 0])
        loss = fit._update_loss(task, model, data, config, 0, "cpu")
    assert float(loss) > 0.1  # of data that have about unit spread


def test_embeddings_from_a_file_train_to_the_same_bits(tmp_path: Path) -> None:
    task, frames = pendulum.TASK, FrameAutoencoder(SIZES)
    first = fit.embedded(task, TINY, frames, "train", tmp_path)
    second = fit.embedded(task, TINY, frames, "train", tmp_path)
    assert torch.equal(first.embeddings, second.embeddings)
    assert first.embeddings.data_ptr() % 64 == second.embeddings.data_ptr() % 64 == 0
    weights = []
    for number, data in enumerate((first, second)):
        folder = tmp_path / str(number)
        folder.mkdir()
        model = fit.train_method(task, "alps", data, frames, TINY, SIZES, folder, TimeLimit())
        weights.append([p.detach().clone() for p in model.network.parameters()])
    assert all(torch.equal(one, other) for one, other in zip(*weights, strict=True))


def test_seeds_draw_other_data() -> None:
    one, other = (fit.draw_rollouts(pendulum.TASK, replace(TINY, seed=seed), "test") for seed in (0, 1))
    assert not torch.equal(one.states, other.states)
    below = fit.draw_rollouts(pendulum.TASK, TINY, "below").parameters
    assert float(below.max()) <= pendulum.TASK.seen.low[0]


def test_positions_that_do_not_move_are_costly_without_a_decoder() -> None:
    task = two_body.TASK
    moving = torch.tensor(task.state_scale) * torch.randn(4, 50, 8, generator=torch.Generator().manual_seed(0))
    assert float(spread_loss(task, moving)) < 0.1
    assert float(spread_loss(task, 0.01 * moving)) > 5


def test_the_learned_energy_has_the_gradient_that_is_written_down() -> None:
    torch.manual_seed(0)
    dynamics = HamiltonianDynamics(pendulum.TASK, SIZES).double()
    torch.nn.init.normal_(dynamics.weight)
    place, rate, context = torch.randn(5, 1).double(), torch.randn(5, 1).double(), torch.randn(5, 10).double()

    def energy(q: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        x = torch.cat([torch.cos(q), torch.sin(q), p, context], dim=-1)
        potential = torch.nn.functional.softplus(dynamics.hidden(x)) @ dynamics.weight
        return (potential + 0.5 * (torch.exp(dynamics.mass) * p * p).sum(-1)).sum()

    place.requires_grad_(), rate.requires_grad_()
    expected = torch.autograd.grad(energy(place, rate), (place, rate))
    found = dynamics.gradient(place, rate, context)
    torch.testing.assert_close(found, expected)


def test_without_friction_the_learned_energy_is_kept() -> None:
    torch.manual_seed(0)
    dynamics = HamiltonianDynamics(pendulum.TASK, SIZES).double()
    torch.nn.init.normal_(dynamics.weight, std=0.002)
    dynamics.friction.data.fill_(-60.0)
    dynamics.hidden.weight.data[:, -10:] = 0
    start = torch.tensor([[0.5, 0.2]]).double()
    for weight in dynamics.parameters():
        weight.requires_grad_(False)
    path = dynamics(start, torch.zeros(1, 10).double(), torch.zeros(1, 400, 0).double())
    scale = dynamics.scale[1]
    x = torch.cat([torch.cos(path[..., :1]), torch.sin(path[..., :1]), path[..., 1:] / scale], dim=-1)[0]
    hidden = torch.nn.functional.softplus(x @ dynamics.hidden.weight[:, :3].mT + dynamics.hidden.bias)
    energy = hidden @ dynamics.weight + 0.5 * torch.exp(dynamics.mass[0]) * x[:, 2] ** 2
    swing = float((x[:, 2].square() * 0.5 * torch.exp(dynamics.mass[0])).max())
    assert swing > 0 and float(energy.max() - energy.min()) < 0.1 * swing
