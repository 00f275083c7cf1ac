"""The paper's systems: equations, corrected slips, solvers, pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sprung.model.alps import mass_spring_damper, pendulum, two_body
from sprung.model.alps.config import NetworkConfig
from sprung.model.alps.encoder import AttentionEncoder
from sprung.model.alps.rollout import held, runge_kutta
from sprung.model.alps.task import ROLLOUT, WINDOW, Rollouts, Task, windows

SIZES = NetworkConfig()
TASKS = [pendulum.TASK, mass_spring_damper.TASK, two_body.TASK]
each_task = pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)


def rollouts(task: Task, count: int = 6) -> Rollouts:
    return task.sample(count, np.random.default_rng(3), task.seen)


@each_task
def test_rollouts_have_the_papers_sizes_and_parameters_within_range(task: Task) -> None:
    drawn = rollouts(task)
    assert drawn.states.shape == (6, ROLLOUT, len(task.states))
    assert drawn.inputs.shape == (6, ROLLOUT, task.inputs)
    low, high = torch.tensor(task.seen.low), torch.tensor(task.seen.high)
    assert bool(((drawn.parameters >= low) & (drawn.parameters <= high)).all())
    assert ROLLOUT - WINDOW + 1 == 26


@each_task
def test_the_simulator_reproduces_the_truth_from_its_own_start_and_parameters(task: Task) -> None:
    drawn = rollouts(task)
    again = task.simulate(drawn.states[:, 0], drawn.parameters, drawn.inputs)
    error = task.difference(again, drawn.states) / torch.tensor(task.state_scale)
    assert float(error.abs().amax((1, 2)).median()) < 1e-3


@each_task
def test_the_simulation_depends_differentiably_on_start_and_parameters(task: Task) -> None:
    drawn = rollouts(task, 2)
    start = drawn.states[:, 0].clone().requires_grad_()
    parameters = drawn.parameters.clone().requires_grad_()
    path = task.simulate(start, parameters, drawn.inputs[:, :20])
    slopes = torch.autograd.grad(path.square().sum(), [start, parameters])
    assert all(bool(torch.isfinite(slope).all()) and float(slope.abs().max()) > 0 for slope in slopes)


@pytest.mark.parametrize("task", [pendulum.TASK, two_body.TASK], ids=lambda task: task.name)
def test_the_adjoint_of_a_path_is_its_gradient(task: Task) -> None:
    drawn = rollouts(task, 2)
    inputs = torch.zeros(2, 5, 0)
    start = drawn.states[:, 0].clone().requires_grad_()
    parameters = drawn.parameters.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, p: task.simulate(x, p, inputs), (start, parameters))


def test_the_pendulum_opens_with_its_angle_up_to_the_sense_of_turning() -> None:
    torch.manual_seed(0)
    angle = torch.from_numpy(np.random.default_rng(0).normal(0, 0.8, 500)).float()
    mix = torch.randn(2, SIZES.embedding)
    embeddings = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1) @ mix + 0.3
    encoder = AttentionEncoder(pendulum.TASK, SIZES).requires_grad_(False)
    encoder.head.straighten(pendulum.TASK.placed)
    encoder.head.open_with_components(embeddings)
    opened = encoder(embeddings.unflatten(0, (5, WINDOW))).mean[..., 0].flatten()
    torch.testing.assert_close(opened.abs(), angle.abs(), atol=0.1, rtol=0)


def test_runge_kutta_converges_with_order_four() -> None:
    start = torch.tensor([[1.0, 0.0]], dtype=torch.float64)

    def error(steps: int) -> float:
        end = runge_kutta(lambda x: torch.stack([x[:, 1], -x[:, 0]], -1), start, steps + 1, 1.0 / steps)[0, -1]
        return float((end - torch.tensor([math.cos(1.0), -math.sin(1.0)], dtype=torch.float64)).norm())

    order = math.log2(error(10) / error(20))
    assert 3.8 < order < 4.3


def test_held_inputs_are_solved_exactly() -> None:
    stiffness = torch.tensor([[2e6]], dtype=torch.float64)
    a, b = mass_spring_damper.matrices(stiffness)
    rng = np.random.default_rng(1)
    inputs = torch.from_numpy(rng.normal(0, 0.05, (1, 13, 2)))
    start = torch.from_numpy(rng.normal(0, 0.1, (1, 4)))
    path = held(a, b, start, inputs, 0.01)[0].numpy()
    state = start[0].numpy()
    for step in range(12):
        drive = (b[0] @ inputs[0, step]).numpy()
        matrix = a[0].numpy()
        found = solve_ivp(lambda _, x, m=matrix, w=drive: m @ x + w, (0, 0.01), state, rtol=1e-11, atol=1e-13)
        state = found.y[:, -1]
        np.testing.assert_allclose(path[step + 1], state, rtol=1e-7, atol=1e-10)


def test_mass_two_is_damped_by_its_own_damper() -> None:
    a, _ = mass_spring_damper.matrices(torch.tensor([[2e6]], dtype=torch.float64))
    assert float(a[0, 3, 3]) < 0  # the paper prints it positive
    assert float(torch.linalg.eigvals(a[0]).real.max()) < 0


def test_the_pendulum_loses_energy_by_friction_only() -> None:
    def energy(states: torch.Tensor) -> torch.Tensor:
        return 0.5 * states[..., 1] ** 2 - 10.0 * torch.cos(states[..., 0])

    start = torch.tensor([[1.0, 0.5]], dtype=torch.float64)
    nothing = torch.zeros(1, 50, 0, dtype=torch.float64)
    free = energy(pendulum.simulate(start, torch.zeros(1, 1, dtype=torch.float64), nothing))
    damped = energy(pendulum.simulate(start, torch.full((1, 1), 0.5, dtype=torch.float64), nothing))
    assert float((free - free[0, 0]).abs().max()) < 1e-3
    assert bool((damped.diff(dim=1) < 1e-9).all())


def test_the_two_bodies_attract_and_keep_their_binding_energy() -> None:
    drawn = rollouts(two_body.TASK)
    force = two_body.derivative(drawn.states[:, 0])[:, 4:6]
    towards = drawn.states[:, 0, 2:4] - drawn.states[:, 0, 0:2]
    assert bool(((force * towards).sum(1) > 0).all())
    kept = two_body.energy(drawn.states)
    assert float((kept - drawn.parameters).abs().max()) < 1e-5


def test_the_estimated_energy_sets_the_size_of_the_momenta() -> None:
    state = rollouts(two_body.TASK).states[:, 0]
    wanted = torch.full((6, 1), 0.6, dtype=torch.float64)
    changed = two_body.with_energy(state, wanted)
    torch.testing.assert_close(two_body.energy(changed), wanted[:, 0])
    torch.testing.assert_close(changed[:, :4], state[:, :4])


@each_task
def test_pictures_are_small_anti_aliased_and_follow_the_state(task: Task) -> None:
    assert task.render is not None
    states = rollouts(task).states[:, 40]
    pictures = task.render(states)
    assert pictures.shape == (6, 3, 64, 64)
    assert float(pictures.min()) >= 0 and float(pictures.max()) <= 1
    between = (pictures > 0.02) & (pictures < 0.15)
    assert bool(between.any())  # edges are blended
    nudged = states.clone()
    nudged[:, 0] += 0.05 * task.state_scale[0]  # less than a pixel
    assert bool(((task.render(nudged) - pictures).abs().amax((1, 2, 3)) > 0.003).all())


def test_a_disc_covers_its_area() -> None:
    from sprung.model.alps.rendering import disc

    column, row = torch.tensor([31.2, 20.9]), torch.tensor([30.0, 40.4])
    area = disc(column, row, 5.0).sum((1, 2))
    torch.testing.assert_close(area, torch.full((2,), math.pi * 25), rtol=0.02, atol=0)


def test_the_symmetries_of_two_bodies_are_aligned_away() -> None:
    true = rollouts(two_body.TASK).states
    turn = torch.tensor([[math.cos(1), math.sin(1)], [math.sin(1), -math.cos(1)]], dtype=torch.float64)
    turned = (true.reshape(6, ROLLOUT, 4, 2) @ turn).reshape(true.shape)
    shifted = turned.clone()
    shifted[..., :4] += torch.tensor([1.0, 2.0, 1.0, 2.0])
    exchanged = shifted[..., [2, 3, 0, 1, 6, 7, 4, 5]]
    torch.testing.assert_close(two_body.align(exchanged, true)(exchanged), true)
    assert float((two_body.align(0.5 * true, true)(0.5 * true) - true).abs().max()) > 0.1  # size is no symmetry


def test_windows_are_cut_where_asked() -> None:
    counted = torch.arange(3 * ROLLOUT).reshape(3, ROLLOUT)
    cut = windows(counted, torch.tensor([0, 25]), torch.tensor([1, 2]))
    assert cut[0, 0] == ROLLOUT
    assert cut[1, -1] == 3 * ROLLOUT - 1
