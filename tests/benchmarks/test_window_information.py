"""What windows and their magnitudes tell of a parameter, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sprung.benchmarks import window_information as information
from sprung.model.alps import mass_spring_damper, pendulum, two_body
from sprung.model.alps.mass_spring_damper import INPUT_STD
from sprung.model.alps.task import WINDOW, Rollouts, Task

TIME = torch.arange(WINDOW, dtype=torch.float64)
TURN = 2 * math.pi * 7 / WINDOW  # on a bin


def few(task: Task) -> Rollouts:
    return task.sample(6, np.random.default_rng(0), task.seen)


def sine(*slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of 2 sin(TURN t + 0.3) by what is unknown, and the signal itself."""
    chart = 2 * torch.sin(TURN * TIME + 0.3)
    # a little of everything else, as a spectrum without magnitude has no derivative
    chart = chart + 1e-6 * torch.randn(WINDOW, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.stack(slopes, dim=-1)[None, :, None], chart[None, :, None]


def test_an_amplitude_is_identified_as_well_from_magnitudes() -> None:
    by_phase, by_amplitude = 2 * torch.cos(TURN * TIME + 0.3), torch.sin(TURN * TIME + 0.3)
    jacobian, chart = sine(by_phase, by_amplitude)
    expected = math.sqrt(2 / math.pi) * 0.01 * math.sqrt(2 / WINDOW)  # deviation of an amplitude: s sqrt(2 / T)
    assert math.isclose(information.bound(jacobian, 0.01, 1e3), expected, rel_tol=1e-6)
    kept = information.seen_in_magnitudes(jacobian[..., 1:], chart)  # a phase is no unknown of theirs
    assert math.isclose(information.bound(kept, 0.01, 1e3), expected, rel_tol=1e-4)


def test_a_phase_is_not_identifiable_from_magnitudes() -> None:
    jacobian, chart = sine(2 * torch.cos(TURN * TIME + 0.3))
    assert information.bound(jacobian, 0.01, 1.0) < 0.002
    lost = information.bound(information.seen_in_magnitudes(jacobian, chart), 0.01, 1.0)
    assert math.isclose(lost, math.sqrt(2 / math.pi), rel_tol=1e-2)  # the prior


def test_magnitudes_are_never_more_informative_than_states() -> None:
    for task in (pendulum.TASK, mass_spring_damper.TASK, two_body.TASK):
        jacobian, charts = information.sensitivity(task, few(task))
        span = task.seen.high[0] - task.seen.low[0]
        states = information.bound(jacobian, 0.01, span)
        assert 0 < states < information.bound(information.seen_in_magnitudes(jacobian, charts), 0.01, span)


def test_the_parameter_that_a_start_implies_moves_the_window_as_the_simulator_says() -> None:
    task, drawn = two_body.TASK, few(two_body.TASK)
    jacobian, charts = information.sensitivity(task, drawn)
    assert jacobian.shape == (*charts.shape, 8)
    assert task.read_off is not None
    start = drawn.states[torch.arange(6), torch.arange(6)]
    value = task.read_off(start)
    path = [task.to_chart(task.simulate(start, value + step, drawn.inputs[:, :WINDOW])) for step in (1e-5, -1e-5)]
    moved = (path[0] - path[1]) / 2e-5  # more energy by the momenta alone: one of the directions in which it grows
    span = jacobian.flatten(1, 2)
    fitted = torch.linalg.lstsq(span, moved.flatten(1)[..., None]).solution
    torch.testing.assert_close(span @ fitted, moved.flatten(1)[..., None], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(fitted[:, -1, 0], torch.ones(6, dtype=torch.float64), rtol=1e-3, atol=1e-3)


def test_the_responses_to_single_inputs_add_up_to_the_window() -> None:
    task, drawn = mass_spring_damper.TASK, few(mass_spring_damper.TASK)
    factor = information.response(task, drawn.parameters[2], 5)
    pushes = drawn.inputs[2, : 5 + WINDOW - 1].flatten() / INPUT_STD
    torch.testing.assert_close(factor @ pushes, task.to_chart(drawn.states[2, 5 : 5 + WINDOW]), rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_known_inputs_are_far_more_informative() -> None:
    task = mass_spring_damper.TASK
    drawn = task.sample(12, np.random.default_rng(1), task.seen)
    jacobian, _ = information.sensitivity(task, drawn)
    known = information.bound(jacobian, 0.01, 1e6)
    errors = information.posterior_errors(task, drawn, 0.01, np.random.default_rng(2), grid=40)
    assert known < 0.1 * errors["states"] and errors["states"] < 5e5
