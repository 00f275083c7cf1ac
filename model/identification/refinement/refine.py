"""Refinement: maximum-likelihood parameters of windows by Gauss-Newton on the simulated output.

The unknown initial state is a linear nuisance.  Errors are weighed bin by bin of the DFT: sensor noise and the
noise of the measured inputs are white over bins, so that the residual of bin w has the covariance

    R(w) = R_s + G(w) S_u G(w)^H

whatever the window length; what the DFT of a finite window adds (leakage) lies in the span of the free responses
and is removed with the initial state.  In the time domain the same covariance would be a full (T S) x (T S) matrix.

Noise of the inputs also enters the sensitivities and would pull the estimates towards zero force (errors in
variables).  The likelihood over the true inputs as well has the same minimum as solving J(u^)^H R^-1 r = 0 with
the sensitivities J taken along the smoothed inputs u^ = u + S_u G^H R^-1 r; this is what is iterated.

A window that is weak, as those of a slow train are, has its own maximum far off along what it hardly shows, and what it
shows would be linearised there: springs and loads of all such windows would err alike.  Log-ratios are therefore held
about nominal (`HELD_STD`) while they are iterated; where that ends, one step without it gives what the window says.

One iteration is a full linearisation followed by a chord step: the model is simulated again at the new point and
the old products give a second correction, at a tenth of the price.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sprung.model.chunks import alike, chunks, share
from sprung.model.identification.likelihood.gauss_newton import Chord, Linearisation, WindowBatch
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.likelihood.noise_share import mean_share, noise_share
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.system import System

# A log-ratio less certain than this is reported as not identifiable: its 95 % interval spans a factor of 1.8 to each
# side, so that half the nominal value is indistinguishable from nearly all of it
IDENTIFIABLE_STD = 0.3
WEAK_STD = 0.1  # beyond this the excitation of a window is held against its noise
NOISE_SHARE = 0.15  # of a sensitivity's power, at most
VAGUE_SHARE = (
    0.05  # of all of them, beyond which a load that is less certain than that is not reported, nor what goes with it
)
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step
_SLACK = (
    0.5  # rise of the weighted squares that is no failure: the solution with smoothed inputs is not quite its minimum
)
_PER_UNKNOWN = (
    1.0  # the same, of each unknown, where nothing moves any more: in weak windows noise of the inputs lies along all
)
_RELEASED = 0.7  # largest change of a log-ratio, once it is held no longer
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
    outputs: FloatArray  # simulated sensors, shape (B, T, S); T = 0 unless asked for
    excitation: FloatArray  # power of the strongest input over that of its noise, shape (B,)
    weighed: BoolArray  # whether the next three were computed, shape (B,)
    cross: FloatArray  # change of the log-ratios per deviation, shape (B, P, H); H = 0 unless asked for
    information: FloatArray  # on the deviations, shape (B, H, H)
    score: FloatArray  # slope of the log-likelihood along them, shape (B, H)
    noise: FloatArray  # share of noise in what looks like information on parameters; 0: negligible, shape (B,)
    diverged: BoolArray  # whether the motion under the laws left all bounds, shape (B,)
    ended: BoolArray  # whether the work that was allowed ended first, shape (B,)

    def take(self, at: IntArray) -> Refined:
        """The windows `at` of the batch."""
        return Refined(**{name: getattr(self, name)[at] for name in Refined.__slots__})

    def replaced(self, at: IntArray, others: Refined) -> Refined:
        """With the windows `at` as in another batch."""
        changed = {name: getattr(self, name).copy() for name in Refined.__slots__}
        for name, values in changed.items():
            values[at] = getattr(others, name)
        return Refined(**changed)


class Refines(Protocol):
    """Windows of one system and length refined, linear or with laws."""

    model: WindowModel
    calibration: DeviationSensitivity

    def refine(
        self,
        windows: FloatArray,
        start: FloatArray | None = None,
        *,
        iterations: int = ...,
        states: bool = False,
        loads: bool = False,
        built: bool = False,
        weigh: BoolArray | None = None,
    ) -> Refined:
        """See `Refiner.refine`."""


class Refiner:
    """Gauss-Newton for one system and one window length.

    workers: threads that share the chunks of a batch, see `model.chunks`.
    """

    def __init__(self, system: System, samples: int | None = None, workers: int = 1) -> None:
        self.system, self.workers = system, workers
        self.model = WindowModel(system, samples or system.window)
        self.calibration = DeviationSensitivity(self.model)

    @property
    def observations(self) -> int:
        """Real numbers that a window with every sensor is compared in."""
        everything = np.ones(len(self.system.sensors), dtype=bool)
        return 2 * self.model.band.bins * len(self.model.compression.matrix(everything))

    def refine(
        self,
        windows: FloatArray,
        start: FloatArray | None = None,
        *,
        iterations: int = 12,
        states: bool = False,
        loads: bool = False,
        built: bool = False,
        weigh: BoolArray | None = None,
    ) -> Refined:
        """Refine from `start` (B, P), nominal by default; windows (B, T, C) with NaN columns for absent sensors.

        loads: the system's loads are refined, too, and follow the P parameters in what is returned; built: and so are
        bodies' own values, after the loads.
        weigh: windows (B,) whose evidence on gains, delays and loads is computed as well.
        """
        wanted = torch.as_tensor(np.zeros(len(windows), dtype=bool) if weigh is None else weigh)
        present: BoolArray = ~np.asarray(np.isnan(windows[:, :, len(self.system.inputs) :]).any(axis=1))
        everything = np.arange(len(windows))
        knots = np.concatenate(share(lambda at: self.model.knots(windows[at]), chunks(everything), self.workers))
        loading = self.model.simulator.loading
        size = len(self.system.parameters) + (len(loading) if built else loading.of_loads if loads else 0)
        deviations = len(self.calibration.deviations) if weigh is not None else 0
        progress = _Progress.begin(start, present.shape, size, self.model.states_count, deviations)

        def batch(at: IntArray) -> WindowBatch:
            return self.model.batch(knots[at], windows[at], present[at[0]])

        def iterate(at: IntArray) -> None:
            with torch.no_grad():
                self._iterate(batch(at), progress, torch.as_tensor(at), wanted)

        def conclude(at: IntArray) -> Refined:
            with torch.no_grad():
                excitation = self.model.excitation(windows[at])
                return self._result(batch(at), progress, torch.as_tensor(at), states, wanted, excitation)

        active = everything
        for _ in range(iterations):
            # Those that are weighed side by side: pieces need not be taken apart for it.
            share(
                iterate, self._pieces(present, active[np.argsort(~wanted.numpy()[active], kind="stable")]), self.workers
            )
            # The few that need more are gathered from all chunks.
            active = active[~progress.converged.numpy()[active]]
            if len(active) == 0:
                break
        pieces = self._pieces(present, everything)
        return in_order(share(conclude, pieces, self.workers), np.concatenate(pieces))

    def _pieces(self, present: BoolArray, of: IntArray) -> list[IntArray]:
        return [piece for group in alike(present, of) for piece in chunks(group)]

    def misfit(self, windows: FloatArray, log_ratio: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted squares of the simulated outputs (B,) at given parameters and their gradient (B, P).

        Every sensor must be present.
        """
        with torch.no_grad():
            data = self.model.batch(self.model.knots(windows), windows, np.ones(len(self.system.sensors), dtype=bool))
            at = self.model.linearise(torch.as_tensor(log_ratio), data)
        return at.cost.numpy(), -2 * at.gradient.numpy()

    def _iterate(self, data: WindowBatch, progress: _Progress, rows: Tensor, wanted: Tensor) -> None:
        """A full linearisation and a chord step for the windows `rows`, whose data are given."""
        x, least, best = progress.x[rows], progress.least[rows], progress.best[rows]
        data = self.model.with_lost(x, data)
        at = self.model.linearise(x, data)
        step = _limited(at.step)
        data = self.model.with_lost(x + step, data)
        second = self.model.chord(at, x + step, at.state_after(step), data)
        here, after = self.model.objective(x, at.cost), self.model.objective(x + step, second.cost)
        worse = here > least * (1 + 1e-6) + _SLACK
        std = torch.diagonal(at.covariance, dim1=1, dim2=2).sqrt()
        settled = (second.step.abs() / std).amax(dim=1) < _CONVERGED
        held = after <= here * (1 + 1e-6) + _SLACK + torch.where(settled, _PER_UNKNOWN * x.shape[1], 0.0)
        further = _limited(second.step)
        if self.model.noise.lost:  # the products of before leave out what lost inputs did there, not what they do here
            near = (at.step.abs() / std).amax(dim=1) < _CONVERGED
            settled, further = settled & near, torch.where(near[:, None], further, 0.0)
            held = held | ~near
        small = settled & held
        forward = torch.where(held[:, None], x + step + further, x + step / 3)
        # A step that made things worse is taken back to a third.
        progress.x[rows] = torch.where(worse[:, None], best + (x - best) / 3, forward)
        progress.best[rows] = torch.where(worse[:, None], best, x)
        done = small & ~worse
        progress.least[rows] = torch.where(done, after, torch.where(worse, least, here))
        progress.cost[rows] = torch.where(done, second.cost, torch.where(worse, progress.cost[rows], at.cost))
        progress.released[rows] = second.released - further
        progress.converged[rows] = done
        progress.iterations[rows] += 1
        progress.x0[rows], progress.covariance[rows] = second.x0, at.covariance
        progress.error[rows[:, None], torch.as_tensor(np.flatnonzero(data.present))] = second.error
        self._weigh((done & wanted[rows]).nonzero().squeeze(1), at, second, data, progress, rows)

    def _weigh(
        self, which: Tensor, at: Linearisation, second: Chord, data: WindowBatch, progress: _Progress, rows: Tensor
    ) -> None:
        """Evidence on deviations of the windows `which` of a chunk whose covariance rounding has left positive."""
        which = which[torch.linalg.cholesky_ex(at.covariance[which])[1] == 0]
        if len(which):
            at, second, data = at.take(which), second.take(which), data.take(which)
            carried = self.model.noise.carried(at.transfer.drive)
            given = carried, at.transfer.compliance, self.model.simulator.element_values(at.x)
            second = replace(second, step=second.released)  # of what the window says
            clean, outputs = self.calibration.smoothed(at, second, data, *given)
            shown = self.model.sensitivities.by_drive(at, self.calibration.motions(clean), data)
            found = self.calibration.evidence(at, replace(second, outputs=outputs), data, shown)
            at_rows = rows[which]
            progress.cross[at_rows], progress.information[at_rows] = found.cross, found.information
            progress.score[at_rows], progress.weighed[at_rows] = found.score, True

    def _result(
        self,
        data: WindowBatch,
        progress: _Progress,
        rows: Tensor,
        states: bool,
        wanted: Tensor,
        excitation: FloatArray,
    ) -> Refined:
        self._weigh_unconverged(data, progress, rows, wanted)
        x, x0, covariance = progress.x[rows], progress.x0[rows], progress.covariance[rows]
        x0, data = self.model.settled(x, x0, data)
        identifiable, noise = self._identifiable(data, x, torch.diagonal(covariance, dim1=1, dim2=2).sqrt())
        told, stretch = self._told(x, progress.released[rows])
        signals = len(self.model.compression.matrix(data.present))
        freedom = 2 * self.model.band.bins * signals - self.model.unknowns(data.present) - identifiable.sum(dim=1)
        chi_square = progress.cost[rows] / freedom.clamp_min(1)
        # What the model cannot follow is treated as more noise: intervals keep their coverage.
        covariance = covariance * chi_square.clamp_min(1)[:, None, None] * stretch[:, :, None] * stretch[:, None, :]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.diag(1 / self.model.precision[: x.shape[1]])
        rms = np.full((len(x), len(data.present)), np.nan)
        rms[:, data.present] = data.measured.square().mean(dim=1).sqrt()
        path, shown = x0.new_zeros(len(x), 0, x0.shape[1]), x0.new_zeros(len(x), 0, len(data.present))
        error = progress.error[rows]
        if states or self.model.noise.lost:
            path, shown = self.model.simulated(x, x0, data)
        if self.model.noise.lost:  # the mean of a lost input is not determined, and shifts all sensors
            left = data.measured - shown[:, :, data.present]
            shown[:, :, data.present] += left.mean(dim=1, keepdim=True)
            error[:, data.present] = left.std(dim=1, correction=0)
        if not states:
            path, shown = path[:, :0], shown[:, :0]
        return Refined(
            log_ratio=torch.where(identifiable, told, torch.zeros_like(x)).numpy(),
            covariance=torch.where(both, covariance, prior).numpy(),
            identifiable=identifiable.numpy(),
            converged=progress.converged[rows].numpy(),
            iterations=progress.iterations[rows].numpy(),
            chi_square=chi_square.numpy(),
            freedom=freedom.numpy(),
            error=error.numpy(),
            rms=rms,
            states=path.numpy(),
            outputs=shown.numpy(),
            excitation=excitation,
            weighed=progress.weighed[rows].numpy(),
            cross=torch.where(identifiable[:, :, None], progress.cross[rows] * stretch[:, :, None], 0.0).numpy(),
            information=(progress.information[rows] / chi_square.clamp_min(1)[:, None, None]).numpy(),
            score=(progress.score[rows] / chi_square.clamp_min(1)[:, None]).numpy(),
            noise=noise,
            diverged=np.zeros(len(x), dtype=bool),
            ended=np.zeros(len(x), dtype=bool),
        )

    def _told(self, x: Tensor, released: Tensor) -> tuple[Tensor, Tensor]:
        """What windows say, (B, P), where they were held at log-ratios x, and by what its deviations grow, (B, P).

        Windows are linear in stiffnesses and dampings rather than in their logarithms: those are what the step
        `released` is taken along, as if the window had been linearised at its end.
        """
        along = released[:, : len(self.system.parameters)].clamp(-_RELEASED, _RELEASED)
        told, stretch = x + released, torch.ones_like(x)
        told[:, : along.shape[1]] = x[:, : along.shape[1]] + along.log1p()
        stretch[:, : along.shape[1]] = 1 / (1 + along)
        return told, stretch

    def _weigh_unconverged(self, data: WindowBatch, progress: _Progress, rows: Tensor, wanted: Tensor) -> None:
        """Evidence on deviations of windows that did not converge, at their last iterate."""
        left = (wanted[rows] & ~progress.weighed[rows]).nonzero().squeeze(1)
        if len(left):
            x = progress.x[rows[left]]
            chosen = self.model.with_lost(x, data.take(left))
            at = self.model.linearise(x, chosen)
            everything = torch.arange(len(left))
            self._weigh(everything, at, self.model.chord(at, x, at.x0, chosen), chosen, progress, rows[left])

    def _identifiable(self, data: WindowBatch, x: Tensor, std: Tensor) -> tuple[Tensor, FloatArray]:
        """Which log-ratios x (B, P) with deviations std are identifiable, (B, P), and the windows' noise share, (B,).

        The share of the inputs' noise in the information is computed for windows with any weak parameter only.
        """
        identifiable = std < IDENTIFIABLE_STD
        noise, weak = np.zeros(len(x)), (std > WEAK_STD).any(dim=1).nonzero().squeeze(1)
        if len(weak):
            chosen = data.take(weak)
            share = noise_share(self.model, self.model.linearise(x[weak], chosen), chosen)
            P = len(self.system.parameters)
            of_seen = share[:, :P][:, ~self.model.blind]
            noise[weak.numpy()] = mean_share(of_seen)
            vague = (std[weak, P:] > WEAK_STD).any(dim=1) & (of_seen.mean(dim=1) > VAGUE_SHARE)
            identifiable[weak] &= (share < NOISE_SHARE) & ~(vague[:, None] & (std[weak] > WEAK_STD))
        return identifiable, noise


@dataclass(frozen=True, slots=True)
class _Progress:
    """Current iterates of all windows of a batch; chunks write their own rows."""

    x: Tensor  # log-ratios, shape (B, P)
    best: Tensor  # those of the lowest objective so far, shape (B, P)
    least: Tensor  # the lowest objective so far, shape (B,)
    cost: Tensor  # weighted squares, shape (B,)
    released: Tensor  # from x to what the window says, shape (B, P)
    x0: Tensor  # initial states, shape (B, N)
    covariance: Tensor  # shape (B, P, P)
    error: Tensor  # rms of measured minus simulated, NaN for absent sensors, shape (B, S)
    converged: Tensor  # shape (B,)
    iterations: Tensor  # shape (B,)
    weighed: Tensor  # shape (B,)
    cross: Tensor  # shape (B, P, H)
    information: Tensor  # shape (B, H, H)
    score: Tensor  # shape (B, H)

    @classmethod
    def begin(cls, start: FloatArray | None, shape: tuple[int, ...], P: int, N: int, H: int) -> _Progress:
        B, sensors = shape
        x = torch.zeros(B, P, dtype=torch.float64)
        if start is not None:
            x[:, : start.shape[1]] += torch.as_tensor(start[:, :P])
        return cls(
            x=x,
            best=x.clone(),
            least=torch.full((B,), torch.inf, dtype=torch.float64),
            cost=torch.full((B,), torch.inf, dtype=torch.float64),
            released=torch.zeros(B, P, dtype=torch.float64),
            x0=torch.zeros(B, N, dtype=torch.float64),
            covariance=torch.zeros(B, P, P, dtype=torch.float64),
            error=torch.full((B, sensors), torch.nan, dtype=torch.float64),
            converged=torch.zeros(B, dtype=torch.bool),
            iterations=torch.zeros(B, dtype=torch.long),
            weighed=torch.zeros(B, dtype=torch.bool),
            cross=torch.zeros(B, P, H, dtype=torch.float64),
            information=torch.zeros(B, H, H, dtype=torch.float64),
            score=torch.zeros(B, H, dtype=torch.float64),
        )


def _limited(step: Tensor) -> Tensor:
    return step * (_STEP_LIMIT / step.abs().amax(dim=1, keepdim=True).clamp_min(_STEP_LIMIT))


def in_order(parts: list[Refined], order: np.ndarray) -> Refined:
    """One batch of pieces whose windows are `order` (B,), each in its place."""
    whole = Refined(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in Refined.__slots__})
    return whole if (np.diff(order) > 0).all() else whole.take(np.argsort(order))
