"""Gauss-Newton on windows of a system with laws: a linearisation and two steps an iteration.

The model is brought to its own motion again at the new point, and the old products give the second step.  Points are
compared by what they leave as they are: what the best first state would leave is far too small where a force jumps, as
long as that state is far.  Gains and delays are weighed where a window has converged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.calibration import DeviationSensitivity
from sprung.model.identification.gauss_newton import WindowBatch
from sprung.model.identification.law_flow import Flow
from sprung.model.identification.law_noise import by_noise
from sprung.model.identification.law_opening import opened
from sprung.model.identification.law_point import Columns, Moved, Steps, WindowPoint
from sprung.model.identification.law_window import LawWindows
from sprung.model.identification.linearise import PRIOR_STD
from sprung.model.identification.noise_share import mean_share, noise_share
from sprung.model.identification.refine import IDENTIFIABLE_STD, NOISE_SHARE, WEAK_STD, Refined
from sprung.model.signals import FloatArray

ITERATIONS = 6
_CONVERGED = 0.3  # a second step this small, in standard deviations, leaves an error far below it
_STILL = 0.3  # a first step this small: the window stands at its minimum, whatever the second one says
_SLACK = 2.0  # of squares of residuals, by which a step may be worse: forces and smoothed inputs settle no closer
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step


@dataclass(frozen=True, slots=True)
class Second:
    """A second step with the products of the first."""

    point: WindowPoint  # before it
    motion: Moved
    residual: Tensor  # whitened, (B, K, 1)
    cost: Tensor  # (B,)
    step: Tensor  # of the unknowns, (B, U)
    alone: Tensor  # of the first state without that, (B, N)

    @property
    def there(self) -> Tensor:
        """Squares of the residual, (B,); the cost is what the best first state would leave, were the model linear."""
        return self.residual.square().sum(dim=(1, 2))

    @property
    def outputs(self) -> Tensor:
        """Simulated before it, (B, T, S')."""
        return self.motion.outputs

    def small(self, std: Tensor) -> Tensor:
        """Whether windows have converged, (B,); std: of the unknowns, (B, U)."""
        return (self.step.abs() / std).amax(dim=1) < _CONVERGED

    def take(self, at: Tensor) -> Second:
        """Some of the windows."""
        motion = Moved(self.motion.states[at], self.motion.outputs[at], self.motion.lost[at])
        return Second(self.point.take(at), motion, self.residual[at], self.cost[at], self.step[at], self.alone[at])

    def put(self, at: Tensor, some: Second) -> None:
        """Replace some of the windows."""
        self.point.put(at, some.point)
        self.motion.states[at], self.motion.outputs[at] = some.motion.states, some.motion.outputs
        self.motion.lost[at] = some.motion.lost
        self.residual[at], self.cost[at] = some.residual, some.cost
        self.step[at], self.alone[at] = some.step, some.alone


class LawSearch:
    """Windows with the same sensors present, from log-ratios (B, P + laws' values), loads at zero.

    wanted: windows (B,) whose evidence on gains and delays is computed; weighs: whether that of any in the whole batch,
    of which these are a piece, is: all pieces then have room for it.
    """

    def __init__(
        self,
        windows: LawWindows,
        calibration: DeviationSensitivity,
        data: WindowBatch,
        start: FloatArray,
        wanted: Tensor,
        weighs: bool,
    ) -> None:
        self.windows, self.calibration, self.data, self.wanted = windows, calibration, data, wanted
        B, U, T, N = len(start), windows.unknowns, windows.model.samples, windows.model.states_count
        self.told, H = windows.told, len(calibration.deviations) if weighs else 0
        unknowns = torch.zeros(B, U, dtype=torch.float64)
        unknowns[:, : start.shape[1]] = torch.as_tensor(start)
        zero = torch.zeros(B, N, dtype=torch.float64)
        self.point = WindowPoint(unknowns, zero, torch.zeros(B, T, len(windows.acting), dtype=torch.float64))
        self.best = self.point.take(torch.arange(B))
        self.cost = torch.full((B,), torch.inf, dtype=torch.float64)
        self.there = self.cost.clone()  # squares of the residual, by which points are better or worse
        self.covariance = torch.eye(U, dtype=torch.float64).repeat(B, 1, 1)
        self.converged = torch.zeros(B, dtype=torch.bool)
        self.iterations = torch.zeros(B, dtype=torch.long)
        self.error = torch.full((B, len(data.present)), torch.nan, dtype=torch.float64)
        self.states = torch.zeros(B, T, N, dtype=torch.float64)
        self.outputs = torch.full((B, T, len(data.present)), torch.nan, dtype=torch.float64)
        self.smooth = np.zeros((2, B, T, len(windows.system.mechanics.stiffness)))
        self.weighed = torch.zeros(B, dtype=torch.bool)
        self.cross = torch.zeros(B, self.told, H, dtype=torch.float64)
        self.information, self.score = torch.zeros(B, H, H, dtype=torch.float64), torch.zeros(B, H, dtype=torch.float64)

    def run(self, states: bool, near: bool = False, iterations: int = ITERATIONS) -> Refined:
        """Iterate until every window has converged, or `iterations` times; near: the start is no guess."""
        active = self._opened(torch.arange(len(self.cost)), last=iterations == 1)
        if not near and len(active) and iterations > 1:  # once more, where that has led
            self.point.unknowns[active] = self.point.unknowns.median(dim=0).values
            active = self._opened(active, last=False)
        for left in reversed(range(iterations - 1)):
            if len(active) == 0:
                break
            self._iterate(active, last=left == 0)
            active = active[~self.converged[active]]
        return self._result(states)

    def _opened(self, rows: Tensor, last: bool) -> Tensor:
        """Begin with the windows `rows` where they stand, and iterate once; those that have not converged."""
        self.point.put(rows, opened(self.windows, self.point.take(rows), self.data.take(rows)))
        self._iterate(rows, last)
        return rows[~self.converged[rows]]

    def _iterate(self, rows: Tensor, last: bool) -> None:
        """A linearisation and two steps of the windows `rows`; a point that is worse is taken back to a third."""
        w, data, smooth = self.windows, self.data.take(rows), self.smooth[:, rows.numpy()]
        point, before = self.point.take(rows), self.cost[rows]
        steps = w.steps(point, data)
        point, motion, near = w.settle(point, steps, data)
        columns, flow = w.columns(point, steps, motion, data, smooth)
        residual = w.residual(motion.outputs, data, columns.whiten)
        cost, step, alone = columns.solve(residual, point.unknowns)
        there = residual.square().sum(dim=(1, 2))
        worse = ~(there <= self.there[rows] * (1 + 1e-6) + _SLACK)
        step = self._limited(step)
        dx0 = columns.state_step(alone, step)
        smooth = w.smoothed(columns, residual, step, dx0, steps)
        std = torch.diagonal(columns.covariance, dim1=1, dim2=2).sqrt()
        second = self._second(columns, near, point.moved(step, dx0), data)
        held = second.there <= there * (1 + 1e-6) + _SLACK
        still = (step.abs() / std).amax(dim=1) < _STILL
        going = (held & ~still & ~worse & ~second.small(std)).nonzero().squeeze(1)
        if len(going):  # the old products are good enough for one more
            self._third(going, second, columns.take(going), near.take(going), data.take(going))
        done = ((second.small(std) & held) | still) & ~worse & ~motion.lost & ~second.motion.lost
        _, diverged = torch.linalg.cholesky_ex(columns.covariance)  # where the motion has run away it is none
        sane = (diverged == 0) & second.there.isfinite()
        ripe = ((done | last) & sane & self.wanted[rows]).nonzero().squeeze(1)
        if len(ripe):
            weighed = steps.take(ripe), flow.take(ripe), second.take(ripe), data.take(ripe)
            self._weigh(rows[ripe], columns.take(ripe), *weighed)
        more, motion = self._limited(second.step), second.motion
        forward = second.point.moved(more, columns.state_step(second.alone, more))
        forward = forward.where(held, point.moved(step / 3, dx0 / 3))
        best = self.best.take(rows)
        self.point.put(rows, best.towards(point, 1 / 3).where(worse, forward))
        self.best.put(rows, best.where(worse, point))
        self.cost[rows] = torch.where(done & held, second.cost, torch.where(worse, before, cost))
        self.there[rows] = torch.where(worse, self.there[rows], there)
        self.smooth[:, rows.numpy()] = smooth
        covariance, ended = columns.covariance.clone(), ((done | last) & sane).nonzero().squeeze(1)
        if len(ended):
            covariance[ended] += by_noise(w, columns.take(ended), steps.take(ended), flow.take(ended), data.present)
        self.converged[rows], self.covariance[rows], self.states[rows] = done, covariance, motion.states
        self.iterations[rows] += 1
        shown = torch.as_tensor(np.flatnonzero(data.present))
        self.outputs[rows[:, None], :, shown] = motion.outputs.mT
        self.error[rows[:, None], shown] = (data.measured - motion.outputs).square().mean(dim=1).sqrt()

    def _second(self, columns: Columns, flow: Flow, there: WindowPoint, data: WindowBatch) -> Second:
        """The step from `there` with products from nearby."""
        w = self.windows
        there, motion, _ = w.settle(there, w.steps(there, data), data, flow)
        residual = w.residual(motion.outputs, data, columns.whiten)
        return Second(there, motion, residual, *columns.solve(residual, there.unknowns))

    def _third(self, at: Tensor, second: Second, columns: Columns, flow: Flow, data: WindowBatch) -> None:
        """One more step of the windows `at`, whose products are given, where it makes nothing worse."""
        old = second.take(at)
        step = self._limited(old.step)
        there = old.point.moved(step, columns.state_step(old.alone, step))
        new = self._second(columns, flow, there, data)
        better = (new.there <= old.there * (1 + 1e-6) + _SLACK).nonzero().squeeze(1)
        second.put(at[better], new.take(better))

    def _weigh(
        self, rows: Tensor, columns: Columns, steps: Steps, flow: Flow, after: Second, data: WindowBatch
    ) -> None:
        """Evidence on gains and delays of the windows `rows`."""
        given = columns.carried, columns.compliance, steps.values
        clean, outputs = self.calibration.smoothed(columns, after, data, *given)
        after = replace(after, motion=replace(after.motion, outputs=outputs))
        shown = self.windows.by_drive(columns, steps, flow, self.calibration.motions(clean), data)
        found = self.calibration.evidence(columns, after, data, shown)
        self.cross[rows] = found.cross[:, : self.told]
        self.information[rows], self.score[rows], self.weighed[rows] = found.information, found.score, True

    def _limited(self, step: Tensor) -> Tensor:
        """Steps of log-ratios no larger than `_STEP_LIMIT`; the whole step is shortened."""
        largest = step[:, : self.told].abs().amax(dim=1, keepdim=True)
        return step * (_STEP_LIMIT / largest.clamp_min(_STEP_LIMIT))

    def _result(self, states: bool) -> Refined:
        w, data = self.windows, self.data
        found, covariance = self.point.unknowns[:, : self.told], self.covariance[:, : self.told, : self.told]
        std = torch.diagonal(covariance, dim1=1, dim2=2).sqrt()
        identifiable = std < IDENTIFIABLE_STD
        P = len(w.system.parameters)
        share, weak = np.zeros(len(found)), (std[:, :P] > WEAK_STD).any(dim=1).nonzero().squeeze(1)
        if len(weak):
            chosen = data.take(weak)
            noise = noise_share(w.model, w.model.linearise(found[weak][:, w.linear], chosen), chosen)
            identifiable[weak, :P] &= noise[:, :P] < NOISE_SHARE
            share[weak.numpy()] = mean_share(noise[:, :P])
        signals = len(w.model.compression.matrix(data.present))
        taken = self.states.shape[2] + len(w.memories) + identifiable.sum(dim=1)
        freedom = 2 * w.model.bins * signals - taken
        chi_square = self.cost / freedom.clamp_min(1)
        covariance = covariance * chi_square.clamp_min(1)[:, None, None]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.eye(self.told, dtype=torch.float64) * PRIOR_STD**2
        prior[w.linear, w.linear] = 1 / w.model.precision[: len(w.linear)]
        B = len(found)
        rms = np.full((B, len(data.present)), np.nan)
        rms[:, data.present] = data.measured.square().mean(dim=1).sqrt()
        return Refined(
            log_ratio=torch.where(identifiable, found, 0.0).numpy(),
            covariance=torch.where(both, covariance, prior).numpy(),
            identifiable=identifiable.numpy(),
            converged=self.converged.numpy(),
            iterations=self.iterations.numpy(),
            chi_square=chi_square.numpy(),
            freedom=freedom.numpy(),
            error=self.error.numpy(),
            rms=rms,
            states=self.states.numpy() if states else np.zeros((B, 0, self.states.shape[2])),
            outputs=self.outputs.numpy() if states else np.zeros((B, 0, len(data.present))),
            excitation=np.full(B, np.inf),  # told by the windows
            weighed=self.weighed.numpy(),
            cross=torch.where(identifiable[:, :, None], self.cross, 0.0).numpy(),
            information=(self.information / chi_square.clamp_min(1)[:, None, None]).numpy(),
            score=(self.score / chi_square.clamp_min(1)[:, None]).numpy(),
            noise=share,
        )
