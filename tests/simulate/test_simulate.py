"""The exact solution and the ODE path against closed forms and each other."""

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import Tensor

from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import LinearSimulator, phi_functions
from sprung.model.simulate.ode import LinearRate, solve
from sprung.model.system import System, load_system, parse_system
from tests.test_system import OSCILLATOR, QUARTER_CAR


def oscillator(stiffness: float = 800.0, damping: float = 4.0, rate: float = 200) -> System:
    text = OSCILLATOR.replace("800.0", str(stiffness)).replace("sample_rate: 200", f"sample_rate: {rate}")
    damped = f"damping: {damping}" if damping else "damping: {value: 0.0, fixed: true}"
    return parse_system(text.replace("damping: 4.0", damped))


def free_motion(system: System, samples: int, x0: tuple[float, float] = (0.01, 0.0)) -> FloatArray:
    simulator = LinearSimulator(system)
    w = torch.zeros(1, samples, simulator.W, dtype=torch.float64)
    log_ratio = torch.zeros(1, len(system.parameters), dtype=torch.float64)
    return simulator.simulate(log_ratio, w, torch.tensor([x0], dtype=torch.float64))[1][0].numpy()


def test_undamped_energy_is_conserved() -> None:
    x = free_motion(oscillator(damping=0.0), 20000)
    energy = 0.5 * 800 * x[:, 0] ** 2 + 0.5 * 2 * x[:, 1] ** 2
    assert np.ptp(energy) / energy[0] < 1e-9


def test_damped_motion_is_the_closed_form() -> None:
    x = free_motion(oscillator(), 1000)[:, 0]
    t = np.arange(1000) / 200
    decay, omega = 4 / (2 * 2), np.sqrt(800 / 2 - 1)
    exact = 0.01 * np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    assert np.abs(x - exact).max() < 1e-14


def test_phi_functions_match_the_augmented_exponential_at_any_norm() -> None:
    rng = np.random.default_rng(0)
    for size in (1e-3, 1.0, 40.0):
        z = rng.standard_normal((5, 5))
        z *= size / np.abs(z).sum(axis=0).max()
        phi = phi_functions(torch.as_tensor(z)[None])[0].numpy()
        augmented = np.zeros((25, 25))
        augmented[:5, :5] = z
        for block in range(4):
            augmented[5 * block : 5 * block + 5, 5 * block + 5 : 5 * block + 10] = np.eye(5)
        exact = scipy.linalg.expm(augmented)[:5]
        for order in range(5):
            assert np.allclose(phi[order], exact[:, 5 * order : 5 * order + 5], rtol=1e-11, atol=1e-13 * size)


@pytest.mark.parametrize("text", [OSCILLATOR, QUARTER_CAR])
def test_the_exact_step_agrees_with_torchdiffeq(text: str) -> None:
    system = parse_system(text)
    simulator = LinearSimulator(system)
    rng = torch.Generator().manual_seed(3)
    w = torch.randn(2, 30, simulator.W, generator=rng, dtype=torch.float64)
    w[:, :, 1::2] *= 20
    x0 = torch.randn(2, simulator.H.shape[1] * 2, generator=rng, dtype=torch.float64)
    log_ratio = 0.3 * torch.randn(2, len(system.parameters), generator=rng, dtype=torch.float64)
    exact = simulator.simulate(log_ratio, w, x0)[1]
    time = torch.arange(30, dtype=torch.float64) * simulator.dt
    rate = LinearRate(simulator, log_ratio, w)
    with torch.no_grad():
        # Steps that end on the samples, where the drive has its kinks.
        numeric = solve(rate, x0, time, method="rk4", options={"step_size": simulator.dt / 16})
    assert float((numeric.transpose(0, 1) - exact).abs().max() / exact.abs().max()) < 2e-7


def test_rk4_converges_to_the_exact_solution_at_fourth_order() -> None:
    system = parse_system(QUARTER_CAR)
    simulator = LinearSimulator(system)
    w = torch.zeros(1, 20, 2, dtype=torch.float64)
    x0 = torch.tensor([[1.0, 0.3, 0.0, 2.0]], dtype=torch.float64)
    log_ratio = torch.zeros(1, 4, dtype=torch.float64)
    exact = simulator.simulate(log_ratio, w, x0)[1][0, -1]
    time = torch.tensor([0.0, 19 * simulator.dt], dtype=torch.float64)
    errors = []
    for parts in (152, 304, 608):
        rate = LinearRate(simulator, log_ratio, w)
        with torch.no_grad():
            end = solve(rate, x0, time, method="rk4", options={"step_size": 19 * simulator.dt / parts})[-1, 0]
        errors.append(float((end - exact).abs().max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4) < 0.3)


def test_hermite_inputs_converge_at_fourth_order() -> None:
    errors = []
    for rate in (100, 200, 400):
        system = oscillator(rate=rate)
        simulator = LinearSimulator(system)
        t = np.arange(2 * rate) / rate
        drive = 2 * np.pi * 8
        w = torch.as_tensor(np.stack([np.sin(drive * t), drive * np.cos(drive * t)], axis=1))[None]
        m, c, k = 2.0, 4.0, 800.0
        gain = 1 / (k - m * drive**2 + 1j * c * drive)
        steady = np.imag(gain * np.exp(1j * drive * t))
        x0 = torch.tensor([[np.imag(gain), np.real(gain * drive)]], dtype=torch.float64)
        y = simulator.simulate(torch.zeros(1, 3, dtype=torch.float64), w, x0)[0][0, :, 0].numpy()
        errors.append(np.abs(y - steady).max())
    assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > 3.7)


def test_gradients_match_finite_differences() -> None:
    system = parse_system(QUARTER_CAR)
    simulator = LinearSimulator(system)
    generator = torch.Generator().manual_seed(1)
    w = torch.randn(1, 12, 2, generator=generator, dtype=torch.float64)
    x0 = torch.randn(1, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    log_ratio = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)

    scale = simulator.simulate(log_ratio, w, x0)[0].detach().abs().amax(dim=1, keepdim=True)

    def scaled(parameters: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        y, x = simulator.simulate(parameters, w, state)
        return y / scale, x

    assert torch.autograd.gradcheck(scaled, (log_ratio, x0), eps=1e-6, atol=1e-5, rtol=1e-5)


def test_adjoint_gradients_agree_with_the_exact_ones() -> None:
    system = parse_system(OSCILLATOR)
    simulator = LinearSimulator(system)
    w = torch.randn(1, 8, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x0 = torch.tensor([[0.1, 0.0]], dtype=torch.float64)
    time = torch.arange(8, dtype=torch.float64) * simulator.dt
    rate = LinearRate(simulator, torch.zeros(1, 3, dtype=torch.float64), w)
    solve(rate, x0, time, method="rk4", adjoint=True, options={"step_size": simulator.dt / 8}).square().sum().backward()
    log_ratio = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    simulator.simulate(log_ratio, w, x0)[1].square().sum().backward()
    assert rate.log_ratio.grad is not None and log_ratio.grad is not None
    assert torch.allclose(rate.log_ratio.grad, log_ratio.grad, rtol=1e-4)


def test_the_free_response_by_doubling_is_the_stepped_one() -> None:
    system = load_system()
    simulator = LinearSimulator(system)
    discrete = simulator.discretise(simulator.element_values(torch.zeros(1, 24, dtype=torch.float64)))
    free = simulator.free_response(discrete, 37)[0]
    x = torch.eye(18, dtype=torch.float64)
    for k in range(37):
        assert torch.allclose(free[k], discrete.C[0] @ x, rtol=1e-9, atol=1e-9)
        x = discrete.Ad[0] @ x


@pytest.mark.parametrize("text", [QUARTER_CAR, None])
def test_steady_running_computed_over_frequency_is_a_solution_in_time(text: str | None) -> None:
    system = load_system() if text is None else parse_system(text)
    rng = np.random.default_rng(2)
    truth = rng.uniform(-0.4, 0.4, (2, len(system.parameters)))
    runs = simulate_runs(system, truth, 200, rng)
    simulator = LinearSimulator(system)
    w = torch.as_tensor(simulator.knots(runs.clean))
    values = simulator.element_values(torch.as_tensor(truth))
    discrete = simulator.discretise(values)
    measured = torch.as_tensor(runs.clean[:, :, len(system.inputs) :])
    forced = simulator.states(discrete, w, torch.zeros(2, discrete.Ad.shape[1], dtype=torch.float64))
    residual = measured - forced @ discrete.C.mT - w @ discrete.D.mT
    scale = measured.square().mean(dim=1).sqrt()
    free = simulator.free_response(discrete, 200) / scale[:, None, :, None]
    for b in range(2):
        basis, target = free[b].flatten(0, 1), (residual[b] / scale[b]).flatten()
        x0 = torch.linalg.lstsq(basis, target[:, None], driver="gelsd").solution
        assert float((target - (basis @ x0)[:, 0]).square().mean().sqrt()) < 2e-3
