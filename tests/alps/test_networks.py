"""Posteriors, encoders, estimators, decoders and whole networks of the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import i0, i1
from scipy.stats import vonmises

from sprung.model.alps import mass_spring_damper, pendulum, two_body
from sprung.model.alps.config import NetworkConfig, TrainingConfig
from sprung.model.alps.context import ContextDynamics
from sprung.model.alps.embedding import ConvolutionalEmbedding, positions
from sprung.model.alps.encoder import AttentionEncoder, DifferenceEncoder
from sprung.model.alps.estimator import AlpsEstimator, log_magnitudes
from sprung.model.alps.losses import loss_of
from sprung.model.alps.network import Network
from sprung.model.alps.posterior import (
    DivergedTraining,
    gaussian_divergence,
    gaussian_sample,
    von_mises_divergence,
    von_mises_sample,
)
from sprung.model.alps.task import WINDOW, Task

TASKS = [pendulum.TASK, mass_spring_damper.TASK, two_body.TASK]
SIZES = NetworkConfig()
KINDS = ("alps", "no_fourier", "no_attention", "autoencoder", "cdm", "hamiltonian", "decoder_free")


def test_a_posterior_that_is_no_number_ends_the_training_instead_of_drawing_for_ever() -> None:
    k = torch.tensor([1.0, float("nan"), 3.0], dtype=torch.float64)
    with pytest.raises(DivergedTraining, match="has diverged"):
        von_mises_sample(torch.zeros_like(k), k)


@pytest.mark.parametrize("concentration", [0.3, 2.0, 30.0])
def test_von_mises_draws_have_the_right_first_moments(concentration: float) -> None:
    torch.manual_seed(0)
    k = torch.full((40_000,), concentration, dtype=torch.float64)
    draw = von_mises_sample(torch.full_like(k, 0.7), k) - 0.7
    assert float(torch.cos(draw).mean()) == pytest.approx(i1(concentration) / i0(concentration), abs=0.01)
    assert float(torch.sin(draw).mean()) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("concentration", [0.5, 4.0, 20.0])
def test_the_pathwise_gradient_of_a_von_mises_draw_is_that_of_its_quantile(concentration: float) -> None:
    torch.manual_seed(1)
    k = torch.full((50,), concentration, dtype=torch.float64, requires_grad=True)
    draw = von_mises_sample(torch.zeros_like(k), k)
    (slope,) = torch.autograd.grad(draw.sum(), k)
    step = 1e-4 * concentration
    level = vonmises.cdf(draw.detach().numpy(), concentration)
    moved = vonmises.ppf(level, concentration + step) - vonmises.ppf(level, concentration - step)
    np.testing.assert_allclose(slope.numpy(), moved / (2 * step), rtol=2e-2, atol=2e-4)


def test_divergences_are_zero_at_the_prior_and_match_numerical_integration_elsewhere() -> None:
    zero = torch.zeros((), dtype=torch.float64)
    assert float(gaussian_divergence(zero, zero)) == 0
    assert float(von_mises_divergence(zero, torch.ones_like(zero))) == pytest.approx(0, abs=1e-12)
    mean, k = 0.8, 5.0
    grid = np.linspace(-math.pi, math.pi, 20_001)
    p, q = vonmises.pdf(grid, k, loc=mean), vonmises.pdf(grid, 1.0)
    expected = np.trapezoid(p * np.log(p / q), grid)
    found = von_mises_divergence(torch.tensor(mean, dtype=torch.float64), torch.tensor(k, dtype=torch.float64))
    assert float(found) == pytest.approx(expected, rel=1e-6)


def test_gaussian_draws_carry_gradients_to_mean_and_spread() -> None:
    mean, log_std = torch.zeros(5, requires_grad=True), torch.zeros(5, requires_grad=True)
    gaussian_sample(mean, log_std).sum().backward()
    assert mean.grad is not None and log_std.grad is not None
    assert bool((mean.grad == 1).all()) and float(log_std.grad.abs().min()) > 0


def test_position_signals_differ_between_all_samples() -> None:
    signal = positions(WINDOW, SIZES.width)
    distance = torch.cdist(signal, signal) + torch.eye(WINDOW)
    assert float(distance.min()) > 0.1


def test_feature_points_follow_a_shifted_picture() -> None:
    torch.manual_seed(0)
    embed = ConvolutionalEmbedding(SIZES)
    picture = torch.zeros(1, 3, 64, 64)
    picture[:, :, 20:28, 20:28] = 1
    with torch.no_grad():
        still, moved = embed(picture), embed(torch.roll(picture, 8, dims=3))
    columns = (moved - still)[0, :16]
    rows = (moved - still)[0, 16:]
    assert float(columns.abs().mean()) > 3 * float(rows.abs().mean())


def test_attention_sees_the_whole_window_and_differences_only_neighbours() -> None:
    torch.manual_seed(0)
    task = two_body.TASK
    embeddings = torch.randn(1, WINDOW, SIZES.embedding)
    changed = embeddings.clone()
    changed[0, 90] += 1
    for encoder, sees in ((AttentionEncoder(task, SIZES), True), (DifferenceEncoder(task, SIZES), False)):
        with torch.no_grad():
            gap = (encoder(changed).mean - encoder(embeddings).mean).abs().amax(-1)[0]
        assert (float(gap[5]) > 0) is sees


def test_rates_are_first_order_differences_across_the_turn_of_an_angle() -> None:
    encoder = DifferenceEncoder(pendulum.TASK, SIZES)
    angle = torch.tensor([[3.0, 3.1, -3.1, -3.0]])[..., None]
    rates = encoder._with_rates(angle)[0, :, 1]
    expected = torch.tensor([0.1, 2 * math.pi - 6.2, 0.1, 0.1]) * 20
    torch.testing.assert_close(rates, expected, rtol=1e-4, atol=1e-4)


def test_magnitudes_do_not_see_a_circular_shift_and_raw_states_do() -> None:
    states = torch.randn(3, WINDOW, 2)
    torch.testing.assert_close(log_magnitudes(states), log_magnitudes(states.roll(7, dims=1)), atol=1e-4, rtol=1e-4)


def test_estimates_start_in_the_middle_and_stay_positive() -> None:
    task = mass_spring_damper.TASK
    estimator = AlpsEstimator(task, SIZES, log_magnitudes).requires_grad_(False)
    states = task.sample(4, np.random.default_rng(0), task.seen).states[:, :WINDOW].float()
    torch.testing.assert_close(estimator(states), estimator.at_middle(4))
    assert float(estimator.at_middle(1)) == pytest.approx(2.002e6, rel=1e-3)
    with torch.no_grad():
        last = estimator.net[-1]
        assert isinstance(last, torch.nn.Linear)
        last.bias.sub_(100)
    assert float(estimator(states).min()) > 0


@pytest.mark.parametrize("method", KINDS)
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_every_method_learns_from_a_batch_through_all_its_parts(task: Task, method: str) -> None:
    torch.manual_seed(0)
    network = Network(task, method, SIZES)
    embeddings = torch.randn(2, WINDOW, SIZES.embedding)
    inputs = torch.randn(2, WINDOW, task.inputs, dtype=torch.float64) * 0.05
    passed = network(embeddings, inputs, horizon=33)
    assert passed.simulated.shape == (2, WINDOW, len(task.states))
    assert passed.observed is None if method == "decoder_free" else passed.observed.shape == embeddings.shape
    assert (passed.parameters is None) == (method in ("autoencoder", "cdm", "hamiltonian"))
    loss_of(task, passed, embeddings, TrainingConfig(phases=()), 1e-3).total.backward()
    reached = {name.split(".")[0] for name, p in network.named_parameters() if p.grad is not None and p.grad.any()}
    parts = {"encoder"} | (set() if passed.observed is None else {"decoder"})
    parts |= {"estimator"} if passed.parameters is not None else set()
    assert parts | ({"context"} if method in ("cdm", "hamiltonian") else set()) == reached


@pytest.mark.parametrize("method", ["alps", "no_attention"])
def test_with_physics_positions_are_an_affine_image_of_the_embedding(method: str) -> None:
    task = two_body.TASK
    network = Network(task, method, SIZES).requires_grad_(False)
    left, right = torch.randn(2, 1, WINDOW, SIZES.embedding)
    means = [network.encoder(e).mean[..., :4] for e in (left, right, 0.5 * (left + right))]
    torch.testing.assert_close(means[2], 0.5 * (means[0] + means[1]))
    rates = [network.encoder(e).mean[..., 4:] for e in (left, right, 0.5 * (left + right))]
    assert torch.allclose(rates[2], 0.5 * (rates[0] + rates[1]), atol=1e-4) is (method == "no_attention")


def test_over_the_whole_window_the_simulation_starts_at_the_encoded_state() -> None:
    task = pendulum.TASK
    network = Network(task, "alps", SIZES).eval()
    embeddings = torch.randn(2, WINDOW, SIZES.embedding)
    passed = network(embeddings, torch.zeros(2, WINDOW, 0))
    torch.testing.assert_close(passed.simulated[:, 0], passed.encoded.mean[:, 0])
    assert passed.parameters is not None
    path = task.simulate(passed.encoded.mean[:, 0].double(), passed.parameters.double(), torch.zeros(2, WINDOW, 0))
    torch.testing.assert_close(passed.simulated, path.float())


def test_shooting_restarts_at_every_horizon() -> None:
    task = pendulum.TASK
    network = Network(task, "alps", SIZES).eval()
    passed = network(torch.randn(1, WINDOW, SIZES.embedding), torch.zeros(1, WINDOW, 0), horizon=9)
    assert passed.parameters is not None
    again = task.simulate(passed.encoded.mean[:, 9].double(), passed.parameters.double(), torch.zeros(1, 10, 0)).float()
    torch.testing.assert_close(passed.simulated[:, 10:19], again[:, 1:])


def test_methods_are_comparable_in_size() -> None:
    sizes = [sum(p.numel() for p in Network(pendulum.TASK, m, SIZES).parameters()) for m in KINDS[:5]]
    assert max(sizes) / min(sizes) < 2


def test_the_learned_dynamics_stand_still_before_training() -> None:
    task = two_body.TASK
    model = ContextDynamics(task, SIZES)
    states = torch.randn(3, WINDOW, 8)
    path = model(states[:, 0], model.describe(states, torch.zeros(3, WINDOW, 0)), torch.zeros(3, 5, 0))
    torch.testing.assert_close(path, states[:, :1].expand(3, 5, 8))
