"""What a user would write with scipy or filterpy to identify one window; timed and judged beside the product."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import least_squares

from sprung.model.signals import FloatArray
from sprung.model.system import System

Drive = Callable[[float], FloatArray]
Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class PeerFit:
    log_ratio: FloatArray
    seconds: float
    converged: bool


class ScipyPeer:
    """Output-error fit of 24 parameters and 18 initial states by `least_squares` over `solve_ivp`."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.inputs = len(system.inputs)
        self.state_scale = np.r_[np.full(9, 1e-2), np.full(9, 0.2)]

    def fit(self, window: FloatArray, help_given: str, limit: float = 240.0) -> PeerFit:
        """help_given: none (2-point Jacobian of the joint problem, library defaults) or analytic (initial state solved
        by linear algebra, parameters only in the search, a difference step that suits the solver)."""
        begin = time.perf_counter()
        P = len(self.system.parameters)
        u = self._drive(window)
        fit = self._joint if help_given == "none" else self._separated
        ratio, converged = fit(window, u, P, begin + limit)
        return PeerFit(np.log(np.maximum(ratio, 1e-3)), time.perf_counter() - begin, converged)

    def _drive(self, window: FloatArray) -> Drive:
        t = np.arange(len(window)) / self.system.sample_rate
        splines = [CubicHermiteSpline(t, window[:, i], window[:, i + 1]) for i in range(0, self.inputs, 2)]
        rates = [s.derivative() for s in splines]

        def u(time: float) -> FloatArray:
            return np.array([f(time) for pair in zip(splines, rates, strict=True) for f in pair])

        return u

    def _matrices(self, ratio: FloatArray) -> Matrices:
        value = self.system.nominal * ratio
        return self.system.mechanics.matrices(value[:12], value[12:])

    def _simulate(self, ratio: FloatArray, x0: FloatArray, u: Drive, samples: int) -> FloatArray:
        A, B, C, D = self._matrices(ratio)
        t = np.arange(samples) / self.system.sample_rate
        solution = solve_ivp(lambda s, x: A @ x + B @ u(s), (0, t[-1]), x0, t_eval=t, rtol=1e-6, atol=1e-9)
        found: FloatArray = solution.y.T @ C.T + np.array([u(s) for s in t]) @ D.T
        return found

    def _joint(self, window: FloatArray, u: Drive, P: int, deadline: float) -> tuple[FloatArray, bool]:
        measured = window[:, self.inputs :]

        def residual(z: FloatArray) -> FloatArray:
            if time.perf_counter() > deadline:
                raise TimeoutError
            y = self._simulate(z[:P], z[P:] * self.state_scale, u, len(window))
            best[0] = z
            return ((measured - y) / self.system.sensor_noise).ravel()

        best = [np.r_[np.ones(P), np.zeros(18)]]
        try:
            found = least_squares(residual, best[0], x_scale="jac", xtol=1e-6, ftol=1e-6)
        except TimeoutError:
            return best[0][:P], False
        return found.x[:P], bool(found.success)

    def _separated(self, window: FloatArray, u: Drive, P: int, deadline: float) -> tuple[FloatArray, bool]:
        """The help: free responses by the matrix exponential and projected out, and a step for the differences."""
        measured = window[:, self.inputs :]

        def residual(z: FloatArray) -> FloatArray:
            if time.perf_counter() > deadline:
                raise TimeoutError
            y = self._simulate(z, np.zeros(18), u, len(window))
            A, _, C, _ = self._matrices(z)
            step, power, free = scipy.linalg.expm(A / self.system.sample_rate), np.eye(18), []
            for _ in range(len(window)):
                free.append(C @ power / self.system.sensor_noise[:, None])
                power = step @ power
            q, _ = np.linalg.qr(np.concatenate(free))
            r = ((measured - y) / self.system.sensor_noise).ravel()
            best[0] = z
            return r - q @ (q.T @ r)

        best = [np.ones(P)]
        try:
            # Differences of a hundredth stand clear of the solver's tolerance; the default ones drown in it.
            found = least_squares(residual, best[0], diff_step=1e-2, xtol=1e-4, ftol=1e-4, bounds=(0.1, 5.0))
        except TimeoutError:
            return best[0], False
        return found.x, bool(found.success)


def ukf_peer(system: System, window: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Seconds and mean relative error of a joint unscented Kalman filter over the window's samples, one pass."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    dt, P, inputs = 1 / system.sample_rate, len(system.parameters), len(system.inputs)
    scale = np.r_[np.full(9, 1e-2), np.full(9, 0.2), np.ones(P)]

    def matrices(z: FloatArray) -> Matrices:
        value = system.nominal * np.exp(np.clip(z[18:], -2.5, 2.5))
        return system.mechanics.matrices(value[:12], value[12:])

    def move(z: FloatArray, _dt: float, u0: FloatArray, u1: FloatArray) -> FloatArray:
        A, B, *_ = matrices(z)
        step = scipy.linalg.expm(np.block([[A * dt, B * dt], [np.zeros((16, 34))]]))
        x = step[:18, :18] @ (z[:18] * scale[:18]) + step[:18, 18:] @ (u0 + u1) / 2
        found: FloatArray = np.r_[x / scale[:18], z[18:]]
        return found

    def see(z: FloatArray, u: FloatArray) -> FloatArray:
        _, _, C, D = matrices(z)
        found: FloatArray = C @ (z[:18] * scale[:18]) + D @ u
        return found

    points = MerweScaledSigmaPoints(18 + P, alpha=0.1, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(18 + P, 12, dt, see, move, points)
    ukf.x = np.zeros(18 + P)
    ukf.P = np.diag(np.r_[np.ones(18), np.full(P, 0.3**2)])
    ukf.Q = np.diag(np.r_[np.full(18, 1e-6), np.zeros(P)])
    ukf.R = np.diag(system.sensor_noise**2 * 4)
    begin = time.perf_counter()
    try:
        for k in range(1, len(window)):
            ukf.predict(u0=window[k - 1, :inputs], u1=window[k, :inputs])
            ukf.update(window[k, inputs:], u=window[k, :inputs])
    except np.linalg.LinAlgError:
        return time.perf_counter() - begin, float("nan")
    return time.perf_counter() - begin, float(np.abs(np.expm1(ukf.x[18:] - truth)).mean())
