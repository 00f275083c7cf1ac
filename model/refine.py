"""Refinement: maximum-likelihood parameters of windows by Gauss-Newton on the simulated output.

The unknown initial state is a linear nuisance.  Errors are weighed bin by bin of the DFT: sensor noise and the
noise of the measured inputs are white over bins, so that the residual of bin w has the covariance

    R(w) = R_s + G(w) S_u G(w)^H

whatever the window length; what the DFT of a finite window adds (leakage) lies in the span of the free responses
and is removed with the initial state.  In the time domain the same covariance would be a full (T S) x (T S) matrix.

Noise of the inputs also enters the sensitivities and would pull the estimates towards zero force (errors in
variables).  The likelihood over the true inputs as well has the same minimum as solving J(u^)^H R^-1 r = 0 with
the sensitivities J taken along the smoothed inputs u^ = u + S_u G^H R^-1 r; this is what is iterated.

One iteration is a full linearisation followed by a chord step: the model is simulated again at the new point and
the old products give a second correction, at a tenth of the price.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model.chunks import chunks, share
from model.linearise import PRIOR_STD, Chord, Linearisation, WindowBatch, WindowModel
from model.signals import BoolArray, FloatArray, IntArray
from model.system import System

IDENTIFIABLE_STD = 0.3  # a log-ratio less certain than this is reported as not identifiable
_WEAK_STD = 0.1  # beyond this the excitation of a window is held against its noise
_NOISE_SHARE = 0.15  # of a sensitivity's power, at most
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step
_CONVERGED = 0.3  # a chord step this small, in standard deviations, leaves an error far below it


@dataclass(frozen=True, slots=True)
class Refined:
    """Results of a batch; log-ratios, B windows."""

    log_ratio: FloatArray  # shape (B, P)
    covariance: FloatArray  # shape (B, P, P)
    identifiable: BoolArray  # shape (B, P)
    converged: BoolArray  # shape (B,)
    iterations: np.ndarray  # full linearisations, shape (B,)
    chi_square: FloatArray  # per degree of freedom, shape (B,)
    freedom: np.ndarray  # degrees of freedom, shape (B,)
    error: FloatArray  # rms of measured minus simulated, NaN for absent sensors, shape (B, S)
    rms: FloatArray  # rms of measured, NaN for absent sensors, shape (B, S)
    states: FloatArray  # simulated, shape (B, T, N); T = 0 unless asked for


class Refiner:
    """Gauss-Newton for one system and one window length.

    workers: threads that share the chunks of a batch, see `model.chunks`.
    """

    def __init__(self, system: System, samples: int | None = None, workers: int = 1) -> None:
        self.system, self.workers = system, workers
        self.model = WindowModel(system, samples or system.window)

    @property
    def observations(self) -> int:
        """Real numbers that a window with every sensor is compared in."""
        everything = np.ones(len(self.system.sensors), dtype=bool)
        return (2 * self.model.bins - 1) * len(self.model.compression(everything))

    def refine(
        self, windows: FloatArray, start: FloatArray | None = None, *, iterations: int = 12, states: bool = False
    ) -> Refined:
        """Refine from `start` (B, P), nominal by default; windows (B, T, C) with NaN columns for absent sensors."""
        first = np.zeros((len(windows), len(self.system.parameters))) if start is None else start
        present = ~np.isnan(windows[:, :, len(self.system.inputs) :]).any(axis=1)
        patterns, which = np.unique(present, axis=0, return_inverse=True)
        pieces = [
            (pattern, at) for i, pattern in enumerate(patterns) for at in chunks(np.flatnonzero(which.reshape(-1) == i))
        ]

        def work(piece: tuple[BoolArray, IntArray]) -> Refined:
            pattern, at = piece
            with torch.no_grad():
                data = self.model.batch(windows[at], pattern)
                return self._refine_chunk(data, torch.as_tensor(first[at]), iterations, states)

        return _in_order(share(work, pieces, self.workers), np.concatenate([at for _, at in pieces]))

    def misfit(self, windows: FloatArray, log_ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted squares of the simulated outputs (B,) at given parameters and their gradient (B, P).

        Every sensor must be present.
        """
        with torch.no_grad():
            data = self.model.batch(windows, np.ones(len(self.system.sensors), dtype=bool))
            at = self.model.linearise(torch.as_tensor(log_ratio), data)
        return at.cost.numpy(), -2 * at.gradient.numpy()

    def _refine_chunk(self, data: WindowBatch, start: Tensor, iterations: int, states: bool) -> Refined:
        B, P = start.shape
        x = start.to(torch.float64).clone()
        x0 = torch.zeros(B, 2 * self.model.simulator.H.shape[1], dtype=torch.float64)
        covariance = torch.zeros(B, P, P, dtype=torch.float64)
        cost = torch.full((B,), torch.inf, dtype=torch.float64)
        best = x.clone()
        converged = torch.zeros(B, dtype=torch.bool)
        taken = torch.zeros(B, dtype=torch.long)
        error = torch.zeros(B, data.measured.shape[2], dtype=torch.float64)
        active = torch.arange(B)
        for iteration in range(1, iterations + 1):
            chosen = data.take(active)
            at = self.model.linearise(x[active], chosen)
            worse = at.cost > cost[active] * (1 + 1e-6) + 1e-9
            step, second = self._iterate(at, chosen)
            std = torch.diagonal(at.covariance, dim1=1, dim2=2).sqrt()
            held = second.cost <= at.cost * (1 + 1e-6) + 1e-9
            small = ((second.step.abs() / std).amax(dim=1) < _CONVERGED) & held
            final = at.x + step + _limited(second.step)
            # A step that made things worse is taken back to a third.
            retreat = best[active] + (x[active] - best[active]) / 3
            forward = torch.where(held[:, None], final, at.x + step / 3)
            x[active] = torch.where(worse[:, None], retreat, forward)
            better = active[~worse]
            best[better], cost[better] = at.x[~worse], at.cost[~worse]
            done = small & ~worse
            taken[active] = iteration
            x0[active], covariance[active], error[active] = second.x0, at.covariance, second.error
            cost[active[done]] = second.cost[done]
            converged[active[done]] = True
            active = active[~done]
            if len(active) == 0:
                break
        return self._result(data, x, x0, covariance, cost, converged, taken, error, states)

    def _iterate(self, at: Linearisation, data: WindowBatch) -> tuple[Tensor, Chord]:
        """The first step and the chord step from where it leads."""
        step = _limited(at.step)
        return step, self.model.chord(at, at.x + step, at.state_after(step), data)

    def _result(
        self,
        data: WindowBatch,
        x: Tensor,
        x0: Tensor,
        covariance: Tensor,
        cost: Tensor,
        converged: Tensor,
        taken: Tensor,
        error: Tensor,
        states: bool,
    ) -> Refined:
        std = torch.diagonal(covariance, dim1=1, dim2=2).sqrt()
        identifiable = std < IDENTIFIABLE_STD
        weak = (std > _WEAK_STD).any(dim=1).nonzero().squeeze(1)
        if len(weak):
            chosen = data.take(weak)
            share = self.model.noise_share(self.model.linearise(x[weak], chosen), chosen)
            identifiable[weak] &= share < _NOISE_SHARE
        signals = len(self.model.compression(data.present))
        freedom = (2 * self.model.bins - 1) * signals - x0.shape[1] - identifiable.sum(dim=1)
        chi_square = cost / freedom.clamp_min(1)
        # What the model cannot follow is treated as more noise, so that intervals stay honest.
        covariance = covariance * chi_square.clamp_min(1)[:, None, None]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.eye(x.shape[1], dtype=torch.float64) * PRIOR_STD**2
        wrong = np.full((len(x), len(data.present)), np.nan)
        rms = wrong.copy()
        wrong[:, data.present] = error
        rms[:, data.present] = data.measured.square().mean(dim=1).sqrt()
        path = self.model.states(x, x0, data) if states else x0.new_zeros(len(x), 0, x0.shape[1])
        return Refined(
            log_ratio=torch.where(identifiable, x, torch.zeros_like(x)).numpy(),
            covariance=torch.where(both, covariance, prior).numpy(),
            identifiable=identifiable.numpy(),
            converged=converged.numpy(),
            iterations=taken.numpy(),
            chi_square=chi_square.numpy(),
            freedom=freedom.numpy(),
            error=wrong,
            rms=rms,
            states=path.numpy(),
        )


def _limited(step: Tensor) -> Tensor:
    return step * (_STEP_LIMIT / step.abs().amax(dim=1, keepdim=True).clamp_min(_STEP_LIMIT))


def _in_order(parts: list[Refined], order: np.ndarray) -> Refined:
    back = np.argsort(order)
    fields: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])[back] for name in Refined.__slots__
    }
    return Refined(**fields)
