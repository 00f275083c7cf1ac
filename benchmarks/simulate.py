"""`simulate`: batches of one-second windows against torchdiffeq and scipy at equal accuracy.

All solve the same problem: the Manchester vehicle with the same Hermite inputs.  The peers' tolerances and step are
tightened until their states agree with the reference (scipy DOP853 at 1e-12) to 1e-9 of the largest state or better.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from sprung.model.identification.excitation import draw_log_ratios, simulate_runs
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.simulate.ode import LinearRate, solve
from sprung.model.system import load_system


def run(windows: int = 256, scipy_windows: int = 3) -> Iterator[dict[str, Any]]:
    """One dict per figure."""
    system = load_system()
    rng = np.random.default_rng(301)
    truth = draw_log_ratios(system, windows, 0.5, rng)
    simulator = LinearSimulator(system)
    w = torch.as_tensor(simulator.knots(simulate_runs(system, truth, system.window, rng).clean))
    x0 = torch.as_tensor(1e-3 * rng.standard_normal((windows, 18)))
    log_ratio = torch.as_tensor(truth)
    reference = [_scipy(simulator, log_ratio[i : i + 1], w[i : i + 1], x0[i], 1e-12) for i in range(scipy_windows)]

    def error(x: Tensor) -> float:
        return max(float(np.abs(x[i].numpy() - r).max() / np.abs(r).max()) for i, r in enumerate(reference))

    with torch.no_grad():
        seconds, x = _timed(lambda: simulator.simulate(log_ratio, w, x0)[1], 5)
        ours = windows / seconds
        yield {"name": "windows per second, exact", "value": round(ours, 0), "error": error(x), "windows": windows}
        for method, options in (("dopri5", {}), ("rk4", {"step_size": simulator.dt / 8})):
            yield _torchdiffeq(simulator, log_ratio, w, x0, method, options, error, ours)
    begin = time.perf_counter()
    checked = np.stack(
        [_scipy(simulator, log_ratio[i : i + 1], w[i : i + 1], x0[i], 1e-10) for i in range(scipy_windows)]
    )
    rate = scipy_windows / (time.perf_counter() - begin)
    yield {
        "name": "scipy DOP853, one window after the other",
        "value": round(rate, 2),
        "unit": "windows/s",
        "error": error(torch.as_tensor(checked)),
        "ratio": round(ours / rate, 0),
    }


def _torchdiffeq(
    simulator: LinearSimulator,
    log_ratio: Tensor,
    w: Tensor,
    x0: Tensor,
    method: str,
    options: dict[str, float],
    error: Callable[[Tensor], float],
    ours: float,
) -> dict[str, Any]:
    rate = LinearRate(simulator, log_ratio, w)
    grid = torch.arange(w.shape[1], dtype=torch.float64) * simulator.dt
    seconds, x = _timed(
        lambda: solve(rate, x0, grid, method=method, rtol=1e-10, atol=1e-13, options=dict(options)).transpose(0, 1), 1
    )
    return {
        "name": f"torchdiffeq {method}, the whole batch at once",
        "value": round(len(w) / seconds, 1),
        "unit": "windows/s",
        "error": error(x),
        "ratio": round(ours * seconds / len(w), 1),
        "target": ">= 50",
    }


def _timed(work: Callable[[], Tensor], repeats: int) -> tuple[float, Tensor]:
    result = work() if repeats > 1 else None
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - begin)
    assert result is not None
    return float(np.median(times)), result


def _scipy(simulator: LinearSimulator, log_ratio: Tensor, w: Tensor, x0: Tensor, tolerance: float) -> np.ndarray:
    """States (T, N) piece by piece: the drive is smooth only between samples."""
    A, b_value, b_rate = (m[0].numpy() for m in simulator.continuous(simulator.element_values(log_ratio)))
    knots = w[0].numpy()
    x, path, dt = x0.numpy(), [x0.numpy()], simulator.dt
    for k in range(len(knots) - 1):
        p0, m0, p1, m1 = knots[k, 0::2], knots[k, 1::2] * dt, knots[k + 1, 0::2], knots[k + 1, 1::2] * dt
        a2, a3 = 3 * (p1 - p0) - 2 * m0 - m1, 2 * (p0 - p1) + m0 + m1

        def rate(
            t: float,
            x: FloatArray,
            p0: FloatArray = p0,
            m0: FloatArray = m0,
            a2: FloatArray = a2,
            a3: FloatArray = a3,
        ) -> FloatArray:
            s = t / dt
            value = p0 + s * (m0 + s * (a2 + s * a3))
            return A @ x + b_value @ value + b_rate @ ((m0 + s * (2 * a2 + 3 * s * a3)) / dt)

        x = solve_ivp(rate, (0, dt), x, method="DOP853", rtol=max(tolerance, 2.3e-14), atol=tolerance * 1e-3).y[:, -1]
        path.append(x)
    return np.stack(path)
