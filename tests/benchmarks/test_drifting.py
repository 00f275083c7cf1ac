"""Parameters that drift within a trajectory: against the constant simulation, against finer steps, and found again."""

from __future__ import annotations

import numpy as np
import torch

from sprung.benchmarks import drifting
from sprung.model.alps.train_system import STEPS, generate
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import load_system


def test_without_drift_it_is_the_constant_train() -> None:
    data = generate(True, np.random.default_rng(1), 2)
    simulator = LinearSimulator(load_system())
    still = torch.zeros_like(data.log_ratio)
    followed = drifting.follow(simulator, data.log_ratio, still, data.known, data.states[:, 0])
    constant = simulator.states(
        simulator.discretise(simulator.element_values(data.log_ratio)), data.known, data.states[:, 0]
    )
    torch.testing.assert_close(followed, constant, rtol=1e-9, atol=1e-12)


def test_finer_steps_change_little() -> None:
    data = generate(True, np.random.default_rng(2), 2)
    simulator = LinearSimulator(load_system())
    slope = torch.full_like(data.log_ratio, 0.2)
    coarse, fine = (
        drifting.follow(simulator, data.log_ratio, slope, data.known, data.states[:, 0], hold) for hold in (5, 1)
    )
    constant = drifting.follow(simulator, data.log_ratio, 0 * slope, data.known, data.states[:, 0])
    size = fine.square().mean((0, 1)).sqrt()
    assert float(((coarse - fine) / size).abs().max()) < 2e-3
    assert float(((constant - fine) / size).abs().max()) > 0.05


def test_parameters_of_a_window_are_those_of_its_middle() -> None:
    data, slope = drifting.drifting_data(3, 0.2, 4)
    rows, starts = torch.tensor([2, 3]), torch.tensor([0, 400])
    found = drifting._refined(data, rows, starts, 100)
    middle = drifting.at_sample(data.log_ratio[rows], slope[rows], starts + 49.5)
    beginning = drifting.at_sample(data.log_ratio[rows], slope[rows], torch.tensor([0.0, 0.0]))
    assert float((found - middle).abs().mean()) < 0.01
    assert float((found - beginning)[1].abs().mean()) > 3 * float((found - middle)[1].abs().mean())


def test_the_line_goes_through_the_middle() -> None:
    middle, slope = torch.ones(1, 2, dtype=torch.float64), torch.tensor([[0.2, -0.4]], dtype=torch.float64)
    ends = torch.cat([drifting.at_sample(middle, slope, sample) for sample in (0, STEPS - 1)])
    torch.testing.assert_close(ends, torch.tensor([[0.9, 1.2], [1.1, 0.8]], dtype=torch.float64))
