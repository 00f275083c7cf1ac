"""Fourier features of windows.

`magnitudes` is the paper's feature, |DFT| of every signal.  `ForceBalance` keeps the phase between inputs and
responses: Newton's second law of every degree of freedom, bin by bin,

    sum_e H_e^T (k_e d_e + c_e d_e') + M q'' = F p

is linear in the unknown values.  Body motion comes from the redundant sensors by weighted least squares and is
integrated (or differentiated) within the window by splines; constant and slope are projected out of every signal,
which absorbs the unknown initial state exactly; then a Hann window and the DFT.  All of it is one fixed linear map.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from sprung.model.chunks import alike
from sprung.model.mechanics import ACCELERATION, DISPLACEMENT, VELOCITY
from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.simulate.loading import by_inertia
from sprung.model.system import System

BAND = (0.015, 0.25)  # share of the sample rate that the force balance uses


def magnitudes(signals: Tensor) -> Tensor:
    """The paper's Fourier feature (section 4): |DFT| over time, (B, T, C) to (B, (T // 2 + 1) C).

    The upper half of the DFT of real signals repeats the lower and is left out.
    """
    found: Tensor = torch.fft.rfft(signals, dim=1).abs().flatten(1)
    return found


class ForceBalance:
    """Rows of the force balance of windows of one system: regressors times ratios = target.

    Ratios are theta / nominal.  R = n * F * 2 rows: real and imaginary part of every degree of freedom and bin,
    in newtons (or newton metres) times the window's gain.
    """

    def __init__(self, system: System, samples: int) -> None:
        self.system, self.samples = system, samples
        mechanics = system.mechanics
        self.kind = motion_kind(system)
        if self.kind is None:
            raise ValueError(f"{system.name}: the sensors do not give the motion of every body; no force balance")
        frequency = np.fft.rfftfreq(samples, 1 / system.sample_rate)
        low, high = BAND[0] * system.sample_rate, BAND[1] * system.sample_rate
        self.bins: IntArray = np.flatnonzero((frequency >= low) & (frequency <= high)).astype(np.int64)
        self.simulator = LinearSimulator(system)
        time = np.arange(samples) / system.sample_rate
        by_order = _time_operators(self.kind, time)
        spectrum = _spectrum_operator(samples, self.bins)
        self.operators = torch.as_tensor(np.stack([spectrum @ operator for operator in by_order]))  # (3, 2F, T)
        self.plain = torch.as_tensor(spectrum)
        one = torch.ones(len(system.parameters), dtype=torch.float64)
        s = self.simulator
        self.fixed_k, self.fixed_c, self.fixed_m = (  # 1 where a value is not estimated
            1.0 - one @ of for of in (s.k_of, s.c_of, s.m_of)
        )
        self._inverses: dict[bytes, FloatArray] = {}
        self.use = mechanics.sensor_kind == self.kind
        self.noise = np.array([c.noise for c in system.channels])[len(system.inputs) :]

    @property
    def rows(self) -> int:
        return self.system.mechanics.n * 2 * len(self.bins)

    def __call__(self, windows: FloatArray) -> tuple[Tensor, Tensor]:
        """target (B, R) and regressors (B, R, P) of windows (B, T, C)."""
        target, regressors, *_ = self._rows(windows)
        return target, regressors

    def with_loads(self, windows: FloatArray) -> tuple[Tensor, Tensor, Tensor]:
        """As the call, and regressors (B, R, X) of what describes loads, at none."""
        target, regressors, acceleration, spring = self._rows(windows)
        by_load = self._by_load(acceleration, spring).permute(0, 2, 1, 3)  # (B, n, 2F, X)
        return target, regressors, by_load.flatten(1, 2)

    def _rows(self, windows: FloatArray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """target, regressors, accelerations (B, 2F, n) and nominal forces of the springs (B, 2F, E)."""
        s = self.simulator
        knots = torch.as_tensor(s.knots(windows[:, :, : len(self.system.inputs)]))
        motion = self._motion(windows[:, :, len(self.system.inputs) :])  # (B, T, n)
        q, v, a = (operator @ motion for operator in self.operators)  # each (B, 2F, n)
        drive = self.plain @ knots  # (B, 2F, W)
        spring = (q @ s.H.T + drive[:, :, s.supports] @ s.G.T) * s.nominal_k  # nominal forces, (B, 2F, E)
        damper = (v @ s.H.T + drive[:, :, s.supports + 1] @ s.G.T) * s.nominal_c
        inertia = a * s.nominal_m
        k_at, c_at = s.estimated_elements
        unknown = torch.cat([spring[:, :, k_at], damper[:, :, c_at]], dim=2).unsqueeze(1)  # (B, 1, 2F, P')
        regressors = unknown * torch.cat([s.H[k_at], s.H[c_at]]).T[:, None, :]  # (B, n, 2F, P')
        known = (spring * self.fixed_k + damper * self.fixed_c) @ s.H + inertia * self.fixed_m  # (B, 2F, n)
        if s.estimates_mass:
            by_mass = inertia.mT.unsqueeze(3) * s.m_of[-s.estimated_masses :].T[:, None, :]
            regressors = torch.cat([regressors, by_mass], dim=3)
        if len(s.forces):
            known = known - drive[:, :, s.forces] @ s.F.T
        return -known.mT.flatten(1), regressors.flatten(1, 2), a, spring

    def _by_load(self, a: Tensor, spring: Tensor) -> Tensor:
        """Change of the forces with each term of a load, (B, 2F, n, X), from accelerations and springs' forces."""
        s, X = self.simulator, self.simulator.loading.of_loads
        mass = s.nominal_m.expand(len(a), -1)
        forces = by_inertia(a, mass, None, s.loading.exponents[:X], s.loading.pattern[:X])
        if bool(s.loading.stiffness.any()):
            forces = forces + torch.einsum("bfe,xe,en->bfnx", spring, s.loading.stiffness[:X], s.H)
        return forces

    def _motion(self, sensors: FloatArray) -> Tensor:
        """Motion of the degrees of freedom, weighted least squares over the sensors that are present."""
        present = ~np.isnan(sensors).any(axis=1) & self.use
        out = np.zeros((len(sensors), sensors.shape[1], self.system.mechanics.n))
        for at in alike(present, np.arange(len(sensors))):
            pattern = present[at[0]]
            out[at] = sensors[at][:, :, pattern] @ self._inverse(pattern).T
        return torch.as_tensor(out)

    def _inverse(self, present: BoolArray) -> FloatArray:
        """Weighted pseudo-inverse of the sensors present, (n, S')."""
        key = present.tobytes()
        if key not in self._inverses:
            weight = np.where(self.noise > 0, 1 / np.maximum(self.noise, 1e-300), 1.0)[present]
            S = self.system.mechanics.S[present]
            self._inverses[key] = np.asarray(np.linalg.pinv(S * weight[:, None]) * weight, dtype=np.float64)
        return self._inverses[key]


def motion_kind(system: System) -> int | None:
    """The kind of sensor that alone gives the motion of every degree of freedom, or None."""
    mechanics = system.mechanics
    for kind in (ACCELERATION, DISPLACEMENT, VELOCITY):
        S = mechanics.S[mechanics.sensor_kind == kind]
        if len(S) and np.linalg.matrix_rank(S) == mechanics.n:
            return kind
    return None


def _time_operators(kind: int, time: FloatArray) -> list[FloatArray]:
    """Matrices (T, T) from the measured motion to displacement, velocity and acceleration, by cubic splines."""
    eye = np.eye(len(time))
    spline = CubicSpline(time, eye)
    if kind == ACCELERATION:
        return [spline.antiderivative(2)(time), spline.antiderivative(1)(time), eye]
    if kind == VELOCITY:
        return [spline.antiderivative(1)(time), eye, spline(time, 1)]
    return [eye, spline(time, 1), CubicSpline(time, spline(time, 1))(time, 1)]


def _spectrum_operator(samples: int, bins: IntArray) -> FloatArray:
    """Hann window and DFT after removal of constant and slope; real parts then imaginary parts, (2F, T)."""
    line = np.vander(np.linspace(-1, 1, samples), 2)
    projection = np.eye(samples) - line @ np.linalg.pinv(line)
    hann = np.sin(np.pi * (np.arange(samples) + 0.5) / samples) ** 2
    phase = 2 * np.pi * np.outer(bins, np.arange(samples)) / samples
    found: FloatArray = np.concatenate([np.cos(phase), -np.sin(phase)]) * hann @ projection
    return found
