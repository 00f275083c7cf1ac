"""Refinement: maximum-likelihood parameters of windows by Gauss-Newton on the simulated output.

The unknown initial state is a linear nuisance.  Errors are weighed bin by bin of the DFT: sensor noise and the
noise of the measured inputs are white over bins, so that the residual of bin w has the covariance

    R(w) = R_s + G(w) S_u G(w)^H

whatever the window length; what the DFT of a finite window adds (leakage) lies in the span of the free responses
and is removed with the initial state.  In the time domain the same covariance would be a full (T S) x (T S) matrix.

Noise of the inputs also enters the sensitivities and would pull the estimates towards zero force (errors in
variables).  The likelihood over the true inputs as well has the same minimum as solving J(u^)^H R^-1 r = 0 with
the sensitivities J taken along the smoothed inputs u^ = u + S_u G^H R^-1 r; this is what is iterated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model.frequency import FrequencyModel, bin_frequencies
from model.signals import FloatArray
from model.simulate.linear import Discrete, ElementValues, LinearSimulator
from model.system import System

PRIOR_STD = 1.0  # of a log-ratio: a factor e either way; weak beside any window that tells something
IDENTIFIABLE_STD = 0.3  # a log-ratio less certain than this is reported as not identifiable
BAND = 0.36  # share of the sample rate up to which Hermite interpolation errs by less than 4 %
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step
_CONVERGED = 0.3  # a step this small, in standard deviations, leaves an error of its square
_CHUNK = 64  # windows worked on at a time: larger ones leave the caches


@dataclass(frozen=True, slots=True)
class Refined:
    """Results of a batch; log-ratios, B windows."""

    log_ratio: FloatArray  # shape (B, P)
    covariance: FloatArray  # shape (B, P, P)
    identifiable: np.ndarray  # shape (B, P)
    converged: np.ndarray  # shape (B,)
    iterations: np.ndarray  # shape (B,)
    chi_square: FloatArray  # per degree of freedom, shape (B,)
    freedom: np.ndarray  # degrees of freedom, shape (B,)
    error: FloatArray  # rms of measured minus simulated, shape (B, S)
    rms: FloatArray  # rms of measured, shape (B, S)
    states: FloatArray | None  # simulated, shape (B, T, N)


@dataclass(slots=True)
class _Data:
    """What stays the same over the iterations of a chunk."""

    w: Tensor  # knots, shape (B, T, W)
    y: Tensor  # measured outputs, absent sensors zero, shape (B, T, S)
    present: Tensor  # shape (B, S)
    scale: Tensor  # 1 / noise of a sensor, 0 for an absent one, shape (B, S)


@dataclass(slots=True)
class _Step:
    """One evaluation of the model at the current parameters."""

    delta: Tensor  # Gauss-Newton step, shape (B, P)
    covariance: Tensor  # with the weak prior, shape (B, P, P)
    gradient: Tensor  # J^T R^-1 r, minus half the gradient of the cost, shape (B, P)
    cost: Tensor  # weighted squares with the best initial state, shape (B,)
    predicted: Tensor  # weighted squares after the step, shape (B,)
    residual: Tensor  # time domain, shape (B, T, S)
    x0: Tensor  # shape (B, N)


class Refiner:
    """Gauss-Newton for one system and one window length."""

    def __init__(self, system: System, samples: int | None = None) -> None:
        self.system = system
        self.samples = samples or system.window
        self.simulator = LinearSimulator(system)
        omega = bin_frequencies(self.samples, system.sample_rate)
        self.bins = int(np.searchsorted(omega, 2 * np.pi * BAND * system.sample_rate, side="right"))
        self.frequency = FrequencyModel(self.simulator, omega[: self.bins])
        weight = np.full(self.bins, np.sqrt(2 / self.samples))
        weight[0] = np.sqrt(1 / self.samples)
        self.weight = torch.as_tensor(weight)
        self.inputs = len(system.inputs)
        noise = np.array([channel.noise for channel in system.channels])
        value = torch.as_tensor(self.frequency.input_noise()).to(torch.complex128)
        self.noise_value, self.noise_slope = value, value * self.frequency.jw[:, None]  # of each drive, (F, W/2)
        self.sensor_noise = torch.as_tensor(noise[self.inputs :])

    def refine(
        self, windows: FloatArray, start: FloatArray | None = None, *, iterations: int = 12, states: bool = False
    ) -> Refined:
        """Refine from `start` (B, P), nominal by default; windows (B, T, C) with NaN columns for absent sensors."""
        first = np.zeros((len(windows), len(self.system.parameters))) if start is None else start
        with torch.no_grad():
            parts = [
                self._refine_chunk(windows[i : i + _CHUNK], first[i : i + _CHUNK], iterations, states)
                for i in range(0, len(windows), _CHUNK)
            ]
        return _concatenate(parts)

    @property
    def observations(self) -> int:
        """Real numbers that a window with every sensor is compared in."""
        return (2 * self.bins - 1) * len(self.sensor_noise)

    def misfit(self, windows: FloatArray, log_ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted squares of the simulated outputs (B,) at given parameters and their gradient (B, P)."""
        with torch.no_grad():
            step = self._evaluate(torch.as_tensor(log_ratio), self._prepare(windows))
        return step.cost.numpy(), -2 * step.gradient.numpy()

    def _refine_chunk(self, windows: FloatArray, start: FloatArray, iterations: int, states: bool) -> Refined:
        data = self._prepare(windows)
        B, P = start.shape
        x = torch.as_tensor(start, dtype=torch.float64).clone()
        out = _Accumulator(B, P, self)
        active = torch.arange(B)
        best_cost = torch.full((B,), torch.inf, dtype=torch.float64)
        best_x = x.clone()
        for iteration in range(1, iterations + 1):
            step = self._evaluate(x[active], _take(data, active))
            worse = step.cost > best_cost[active] * (1 + 1e-6) + 1e-9
            better = active[~worse]
            best_cost[better], best_x[better] = step.cost[~worse], x[better]
            std = torch.diagonal(step.covariance, dim1=1, dim2=2).sqrt()
            done = ((step.delta.abs() / std).amax(dim=1) < _CONVERGED) & ~worse
            x[active] = torch.where(
                worse[:, None], best_x[active] + 0.3 * (x[active] - best_x[active]), x[active] + step.delta
            )
            last = iteration == iterations
            closing = torch.ones_like(done) if last else done
            out.store(active[closing], x[active][closing], step, closing, done, iteration)
            active = active[~closing]
            if len(active) == 0:
                break
        return out.result(data, self, states)

    def _prepare(self, windows: FloatArray) -> _Data:
        w = torch.as_tensor(self.simulator.knots(windows[:, :, : self.inputs]))
        measured = np.asarray(windows[:, :, self.inputs :], dtype=np.float64)
        present: np.ndarray = ~np.isnan(measured).any(axis=1)
        y = torch.as_tensor(np.where(present[:, None, :], measured, 0.0))
        noise = self.sensor_noise.expand(len(windows), -1)
        if bool((noise == 0).any()):  # a sensor of unstated noise is taken at one percent of what it shows
            noise = torch.where(noise > 0, noise, 0.01 * y.square().mean(dim=1).sqrt().clamp_min(1e-30))
        shown = torch.as_tensor(present)
        return _Data(w, y, shown, torch.where(shown, 1 / noise, torch.zeros_like(noise)))

    def _evaluate(self, x: Tensor, data: _Data) -> _Step:
        values = self.simulator.element_values(x)
        discrete = self.simulator.discretise(values)
        forced = self.simulator.states(discrete, data.w, data.w.new_zeros(len(x), discrete.Ad.shape[1]))
        residual = (data.y - forced @ discrete.C.mT - data.w @ discrete.D.mT) * data.present[:, None]
        free = self.simulator.free_response(discrete, self.samples) * data.present[:, None, :, None]
        S, N = free.shape[2:]

        response = self.frequency.response(values)
        # Outputs, in units of sensor noise, that unit noises of the drives cause: (B, F, S, W/2).
        carried = (
            response.output[..., 0::2] * self.noise_value[:, None]
            + response.output[..., 1::2] * self.noise_slope[:, None]
        )
        carried = carried * data.scale[:, None, :, None]
        covariance = torch.eye(S, dtype=carried.dtype) + carried @ carried.mH
        whiten = (
            torch.linalg.solve_triangular(
                torch.linalg.cholesky(covariance), torch.diag_embed(data.scale).to(carried.dtype)[:, None], upper=False
            )
            * self.weight[:, None, None]
        )

        spectra = torch.fft.rfft(torch.cat([residual.unsqueeze(3), free], dim=3), dim=1)[:, : self.bins]
        white = _real(whiten @ spectra)  # (B, 2 F S, 1 + N)
        r, basis = white[:, :, 0], white[:, :, 1:]
        column = basis.square().sum(dim=1).sqrt().clamp_min(1e-300)
        basis = basis / column[:, None]
        factor = torch.linalg.cholesky(basis.mT @ basis + 1e-11 * torch.eye(N, dtype=basis.dtype))
        x0 = torch.cholesky_solve((basis.mT @ r.unsqueeze(2)), factor).squeeze(2)
        error = r - (basis @ x0.unsqueeze(2)).squeeze(2)
        x0 = x0 / column

        states = forced + self._free_states(discrete, x0)
        J = self._sensitivities(values, response, states, data, spectra, x0, whiten, carried)
        J = _real(whiten @ J)
        J = J - basis @ torch.cholesky_solve(basis.mT @ J, factor)
        information = J.mT @ J
        gradient = (J.mT @ error.unsqueeze(2)).squeeze(2)
        prior = torch.eye(x.shape[1], dtype=x.dtype) / PRIOR_STD**2
        covariance_x = torch.linalg.inv(information + prior)
        delta = (covariance_x @ (gradient - x / PRIOR_STD**2).unsqueeze(2)).squeeze(2)
        delta = delta * (_STEP_LIMIT / delta.abs().amax(dim=1, keepdim=True).clamp_min(_STEP_LIMIT))
        cost = error.square().sum(dim=1)
        predicted = (error - (J @ delta.unsqueeze(2)).squeeze(2)).square().sum(dim=1)
        time_error = residual - torch.einsum("btsn,bn->bts", free, x0)
        return _Step(delta, covariance_x, gradient, cost, predicted, time_error, x0)

    def _free_states(self, discrete: Discrete, x0: Tensor) -> Tensor:
        nothing = x0.new_zeros(len(x0), self.samples, self.simulator.W)
        return self.simulator.states(discrete, nothing, x0)

    def _sensitivities(
        self,
        values: ElementValues,
        response,
        states: Tensor,
        data: _Data,
        spectra: Tensor,
        x0: Tensor,
        whiten: Tensor,
        carried: Tensor,
    ) -> Tensor:
        """Sensitivity spectra along the smoothed motion, (B, F, S, P)."""
        s = self.simulator
        n = s.H.shape[1]
        position, velocity = states[:, :, :n], states[:, :, n:]
        d = position @ s.H.T + data.w[:, :, s.supports] @ s.G.T
        v = velocity @ s.H.T + data.w[:, :, s.supports + 1] @ s.G.T
        moving = [d, v]
        if s.estimates_mass:
            A, b_value, b_rate = s.continuous(values)
            moving.append(
                states @ A[:, n:].mT + data.w[:, :, 0::2] @ b_value[:, n:].mT + data.w[:, :, 1::2] @ b_rate[:, n:].mT
            )
        motion = torch.fft.rfft(torch.cat(moving, dim=2), dim=1)[:, : self.bins]
        E = s.H.shape[0]
        deflection, rate, acceleration = motion[:, :, :E], motion[:, :, E : 2 * E], motion[:, :, 2 * E :]
        # Expected noise of the drives given the residual, in units of its standard deviation.
        left = spectra[:, :, :, 0] - (spectra[:, :, :, 1:] @ x0[:, None, :, None].to(spectra.dtype)).squeeze(3)
        whitened = (whiten / self.weight[:, None, None]) @ left.unsqueeze(3)
        noise = self._unscaled(whiten, data).mH @ whitened
        noise = (carried.mH @ noise).squeeze(3)  # (B, F, W/2)
        knots = torch.stack([noise * self.noise_value, noise * self.noise_slope], dim=3).flatten(2)  # (B, F, W)
        moved = (response.motion @ knots.unsqueeze(3)).squeeze(3)
        support, support_rate = knots[:, :, s.supports], knots[:, :, s.supports + 1]
        kind = moved.dtype
        H, G = s.H.T.to(kind), s.G.T.to(kind)
        jw = self.frequency.jw[:, None]
        deflection = deflection + moved @ H + support @ G
        rate = rate + (jw * moved) @ H + support_rate @ G
        if s.estimates_mass:
            acceleration = acceleration + jw**2 * moved
        return self.frequency.sensitivities(values, response, deflection, rate, acceleration)

    def _unscaled(self, whiten: Tensor, data: _Data) -> Tensor:
        """Inverse Cholesky factors in units of sensor noise."""
        return whiten / (self.weight[:, None, None] * data.scale.clamp_min(1e-300)[:, None, None, :])


class _Accumulator:
    """Collects the closing evaluation of every window of a chunk."""

    def __init__(self, B: int, P: int, refiner: Refiner) -> None:
        S, N, T = len(refiner.sensor_noise), 2 * refiner.simulator.H.shape[1], refiner.samples
        self.x = torch.zeros(B, P, dtype=torch.float64)
        self.covariance = torch.zeros(B, P, P, dtype=torch.float64)
        self.cost = torch.zeros(B, dtype=torch.float64)
        self.residual = torch.zeros(B, T, S, dtype=torch.float64)
        self.x0 = torch.zeros(B, N, dtype=torch.float64)
        self.converged = torch.zeros(B, dtype=torch.bool)
        self.iterations = torch.zeros(B, dtype=torch.long)

    def store(self, at: Tensor, x: Tensor, step: _Step, closing: Tensor, done: Tensor, iteration: int) -> None:
        self.x[at] = x
        self.covariance[at] = step.covariance[closing]
        self.cost[at] = torch.where(done, step.predicted, step.cost)[closing]
        self.residual[at] = step.residual[closing]
        self.x0[at] = step.x0[closing]
        self.converged[at] = done[closing]
        self.iterations[at] = iteration

    def result(self, data: _Data, refiner: Refiner, states: bool) -> Refined:
        std = torch.diagonal(self.covariance, dim1=1, dim2=2).sqrt()
        identifiable = std < IDENTIFIABLE_STD
        freedom = (2 * refiner.bins - 1) * data.present.sum(dim=1) - self.x0.shape[1] - identifiable.sum(dim=1)
        chi_square = self.cost / freedom.clamp_min(1)
        # What the model cannot follow is treated as more noise, so that intervals stay honest.
        covariance = self.covariance * chi_square.clamp_min(1)[:, None, None]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.eye(self.x.shape[1], dtype=torch.float64) * PRIOR_STD**2
        trajectory = None
        if states:
            discrete = refiner.simulator.discretise(refiner.simulator.element_values(self.x))
            trajectory = refiner.simulator.states(discrete, data.w, self.x0).numpy()
        return Refined(
            log_ratio=torch.where(identifiable, self.x, torch.zeros_like(self.x)).numpy(),
            covariance=torch.where(both, covariance, prior).numpy(),
            identifiable=identifiable.numpy(),
            converged=self.converged.numpy(),
            iterations=self.iterations.numpy(),
            chi_square=chi_square.numpy(),
            freedom=freedom.numpy(),
            error=self.residual.square().mean(dim=1).sqrt().numpy(),
            rms=data.y.square().mean(dim=1).sqrt().numpy(),
            states=trajectory,
        )


def _take(data: _Data, at: Tensor) -> _Data:
    if len(at) == len(data.w):
        return data
    return _Data(data.w[at], data.y[at], data.present[at], data.scale[at])


def _real(spectra: Tensor) -> Tensor:
    """(B, F, S, X) complex to (B, 2 F S, X) real."""
    B, F, S, X = spectra.shape
    flat = torch.view_as_real(spectra).permute(0, 1, 2, 4, 3)
    return flat.reshape(B, F * S * 2, X)


def _concatenate(parts: list[Refined]) -> Refined:
    fields: dict[str, Any] = {}
    for name in Refined.__slots__:
        values = [getattr(part, name) for part in parts]
        fields[name] = None if values[0] is None else np.concatenate(values)
    return Refined(**fields)
