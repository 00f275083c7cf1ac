"""Gauss-Newton on windows of a system with laws: one linearisation and two steps per iteration.

After the first step the motion is simulated again at the new iterate, and the same normal equations give the second
step (a chord step).  Iterates are compared by their own residual, not by the one that the best initial state would
leave: where a force jumps and that state is still far, the linear prediction is much too optimistic.  The evidence on
gains and delays is computed where a window has converged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.likelihood.gauss_newton import WindowBatch
from sprung.model.identification.likelihood.linearise import PRIOR_STD
from sprung.model.identification.likelihood.noise_share import mean_share, noise_share
from sprung.model.identification.measurements.calibration import DeviationSensitivity
from sprung.model.identification.nonlinear.initial import initial_iterate
from sprung.model.identification.nonlinear.input_noise import input_noise_covariance
from sprung.model.identification.nonlinear.iterate import Iterate, LinearStep, NormalEquations, SimulatedMotion
from sprung.model.identification.nonlinear.normal import normal_equations, smoothed
from sprung.model.identification.nonlinear.sensitivities import LawSensitivities
from sprung.model.identification.nonlinear.tangent import TangentModel
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.identification.refinement.refine import IDENTIFIABLE_STD, NOISE_SHARE, WEAK_STD, Refined
from sprung.model.signals import FloatArray
from sprung.model.work import WorkBudget

ITERATIONS = 6  # of a window with laws; one that has not converged by then says so
_CONVERGED = 0.3  # standard deviations: a second step this small leaves a far smaller error
_STATIONARY = 0.3  # standard deviations: after a first step this small the window is at its minimum
_SLACK = 2.0  # increase of the sum of squares that a step may cause: forces and smoothed inputs converge no closer
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step


@dataclass(frozen=True, slots=True)
class SecondStep:
    """A second step with the normal equations of the first."""

    point: Iterate  # it starts from
    motion: SimulatedMotion
    residual: Tensor  # whitened, (B, K, 1)
    cost: Tensor  # (B,)
    step: Tensor  # of the unknowns, (B, U)
    state_alone: Tensor  # of the initial state for unchanged unknowns, (B, N)

    @property
    def squares(self) -> Tensor:
        """Sum of squares of the residual, (B,); the cost is the one with the initial state profiled out."""
        return self.residual.square().sum(dim=(1, 2))

    @property
    def outputs(self) -> Tensor:
        """Simulated at its start, (B, T, S')."""
        return self.motion.outputs

    def small(self, std: Tensor) -> Tensor:
        """Whether windows have converged, (B,); std: of the unknowns, (B, U)."""
        return (self.step.abs() / std).amax(dim=1) < _CONVERGED

    def take(self, at: Tensor) -> SecondStep:
        """Some of the windows."""
        motion = SimulatedMotion(self.motion.states[at], self.motion.outputs[at], self.motion.diverged[at])
        return SecondStep(
            self.point.take(at), motion, self.residual[at], self.cost[at], self.step[at], self.state_alone[at]
        )

    def put(self, at: Tensor, some: SecondStep) -> None:
        """Replace some of the windows."""
        self.point.put(at, some.point)
        self.motion.states[at], self.motion.outputs[at] = some.motion.states, some.motion.outputs
        self.motion.diverged[at] = some.motion.diverged
        self.residual[at], self.cost[at] = some.residual, some.cost
        self.step[at], self.state_alone[at] = some.step, some.state_alone


class LawSearch:
    """Search over windows with the same sensors present, from log-ratios (B, P + law parameters) and loads of zero.

    wanted: windows (B,) for which the evidence on gains and delays is computed; weighs: whether it is computed for any
    window of the whole batch, of which this is a piece: the results of all pieces then have room for it.  work: when it
    has ended, no window is iterated any more.
    """

    def __init__(
        self,
        windows: LawWindows,
        calibration: DeviationSensitivity,
        data: WindowBatch,
        start: FloatArray,
        wanted: Tensor,
        weighs: bool,
        work: WorkBudget,
    ) -> None:
        self.windows, self.calibration, self.data, self.wanted, self.work = windows, calibration, data, wanted, work
        self.sensitivities = LawSensitivities(windows)
        B, U, T, N = len(start), windows.unknowns, windows.model.samples, windows.model.states_count
        self.reported, H = windows.reported, len(calibration.deviations) if weighs else 0
        unknowns = torch.zeros(B, U, dtype=torch.float64)
        unknowns[:, : start.shape[1]] = torch.as_tensor(start)
        zero = torch.zeros(B, N, dtype=torch.float64)
        self.point = Iterate(unknowns, zero, torch.zeros(B, T, len(windows.acting), dtype=torch.float64))
        self.best = self.point.take(torch.arange(B))
        self.cost = torch.full((B,), torch.inf, dtype=torch.float64)
        self.squares = self.cost.clone()  # sums of squares by which iterates are compared
        self.covariance = torch.eye(U, dtype=torch.float64).repeat(B, 1, 1)
        self.converged = torch.zeros(B, dtype=torch.bool)
        self.diverged = torch.zeros(B, dtype=torch.bool)
        self.iterations = torch.zeros(B, dtype=torch.long)
        self.error = torch.full((B, len(data.present)), torch.nan, dtype=torch.float64)
        self.states = torch.zeros(B, T, N, dtype=torch.float64)
        self.outputs = torch.full((B, T, len(data.present)), torch.nan, dtype=torch.float64)
        self.smooth = np.zeros((2, B, T, len(windows.system.mechanics.stiffness)))
        self.weighed = torch.zeros(B, dtype=torch.bool)
        self.cross = torch.zeros(B, self.reported, H, dtype=torch.float64)
        self.information, self.score = torch.zeros(B, H, H, dtype=torch.float64), torch.zeros(B, H, dtype=torch.float64)

    def run(self, states: bool, warm: bool = False, iterations: int = ITERATIONS) -> Refined:
        """Iterate until every window has converged, or `iterations` times; warm: the start is known to be good."""
        active = torch.arange(len(self.cost))
        if not self.work.ended:
            active = self._start(active, last=iterations == 1)
        if not warm and len(active) and iterations > 1 and not self.work.ended:  # again, from the median of that
            self.point.unknowns[active] = self.point.unknowns.median(dim=0).values
            active = self._start(active, last=False)
        for left in reversed(range(iterations - 1)):
            if len(active) == 0 or self.work.ended:
                break
            self._iterate(active, last=left == 0)
            active = active[~self.converged[active]]
        return self._result(states)

    def _start(self, rows: Tensor, last: bool) -> Tensor:
        """Find initial motions of the windows `rows`, iterate once, and return those that have not converged."""
        self.point.put(rows, initial_iterate(self.windows, self.point.take(rows), self.data.take(rows)))
        self._iterate(rows, last)
        return rows[~self.converged[rows]]

    def _iterate(self, rows: Tensor, last: bool) -> None:
        """One linearisation and two steps of the windows `rows`; a step to a worse iterate is shortened to a third."""
        w, data, smooth = self.windows, self.data.take(rows), self.smooth[:, rows.numpy()]
        point, before = self.point.take(rows), self.cost[rows]
        steps = w.steps(point, data)
        point, motion, nearby_tangent = w.settle(point, steps, data)
        normal, tangent = normal_equations(self.sensitivities, point, steps, motion, data, smooth)
        residual = w.residual(motion.outputs, data, normal.whiten)
        cost, step, state_alone = normal.solve(residual, point.unknowns)
        squares = residual.square().sum(dim=(1, 2))
        worse = ~(squares <= self.squares[rows] * (1 + 1e-6) + _SLACK)
        step = self._limited(step)
        dx0 = normal.state_step(state_alone, step)
        smooth = smoothed(w, normal, residual, step, dx0, steps)
        std = torch.diagonal(normal.covariance, dim1=1, dim2=2).sqrt()
        second = self._second_step(normal, nearby_tangent, point.stepped(step, dx0), data)
        improved = second.squares <= squares * (1 + 1e-6) + _SLACK
        stationary = (step.abs() / std).amax(dim=1) < _STATIONARY
        going = (improved & ~stationary & ~worse & ~second.small(std)).nonzero().squeeze(1)
        if len(going):  # the normal equations are good enough for one more
            self._third_step(going, second, normal.take(going), nearby_tangent.take(going), data.take(going))
        done = ((second.small(std) & improved) | stationary) & ~worse & cost.isfinite()
        done &= ~motion.diverged & ~second.motion.diverged
        _, diverged = torch.linalg.cholesky_ex(normal.covariance)  # not positive definite where the motion has diverged
        sane = (diverged == 0) & second.squares.isfinite()
        due = ((done | last) & sane & self.wanted[rows]).nonzero().squeeze(1)
        if len(due):
            weighed = steps.take(due), tangent.take(due), second.take(due), data.take(due)
            self._weigh(rows[due], normal.take(due), *weighed)
        more, motion, lost = self._limited(second.step), second.motion, motion.diverged
        forward = second.point.stepped(more, normal.state_step(second.state_alone, more))
        forward = forward.where(improved, point.stepped(step / 3, dx0 / 3))
        best = self.best.take(rows)
        self.point.put(rows, best.interpolated(point, 1 / 3).where(worse, forward))
        self.best.put(rows, best.where(worse, point))
        self.cost[rows] = torch.where(done & improved, second.cost, torch.where(worse, before, cost))
        self.squares[rows] = torch.where(worse, self.squares[rows], squares)
        self.smooth[:, rows.numpy()] = smooth
        covariance, ended = normal.covariance.clone(), ((done | last) & sane).nonzero().squeeze(1)
        if len(ended):
            covariance[ended] += input_noise_covariance(
                w, normal.take(ended), steps.take(ended), tangent.take(ended), data.present
            )
        self.converged[rows], self.covariance[rows], self.diverged[rows] = done, covariance, lost
        self.iterations[rows] += 1
        self._note_motion(rows, motion, data)

    def _note_motion(self, rows: Tensor, motion: SimulatedMotion, data: WindowBatch) -> None:
        """Note what the windows `rows` show of a simulated motion, and how far it is from what they measured."""
        shown = torch.as_tensor(np.flatnonzero(data.present))
        self.states[rows] = motion.states
        self.outputs[rows[:, None], :, shown] = motion.outputs.mT
        self.error[rows[:, None], shown] = (data.measured - motion.outputs).square().mean(dim=1).sqrt()

    def _second_step(
        self, normal: NormalEquations, tangent: TangentModel, point: Iterate, data: WindowBatch
    ) -> SecondStep:
        """The step from `point` with normal equations of a nearby iterate."""
        w = self.windows
        point, motion, _ = w.settle(point, w.steps(point, data), data, tangent)
        residual = w.residual(motion.outputs, data, normal.whiten)
        return SecondStep(point, motion, residual, *normal.solve(residual, point.unknowns))

    def _third_step(
        self, at: Tensor, second: SecondStep, normal: NormalEquations, tangent: TangentModel, data: WindowBatch
    ) -> None:
        """One more step of the windows `at`, kept where it makes nothing worse."""
        old = second.take(at)
        step = self._limited(old.step)
        point = old.point.stepped(step, normal.state_step(old.state_alone, step))
        new = self._second_step(normal, tangent, point, data)
        better = (new.squares <= old.squares * (1 + 1e-6) + _SLACK).nonzero().squeeze(1)
        second.put(at[better], new.take(better))

    def _weigh(
        self,
        rows: Tensor,
        normal: NormalEquations,
        steps: LinearStep,
        tangent: TangentModel,
        after: SecondStep,
        data: WindowBatch,
    ) -> None:
        """Compute the evidence on gains and delays of the windows `rows`."""
        given = normal.carried, normal.compliance, steps.values
        clean, outputs = self.calibration.smoothed(normal, after, data, *given)
        after = replace(after, motion=replace(after.motion, outputs=outputs))
        shown = self.sensitivities.by_drive(normal, steps, tangent, self.calibration.motions(clean), data)
        found = self.calibration.evidence(normal, after, data, shown)
        self.cross[rows] = found.cross[:, : self.reported]
        self.information[rows], self.score[rows], self.weighed[rows] = found.information, found.score, True

    def _limited(self, step: Tensor) -> Tensor:
        """LinearStep of log-ratios no larger than `_STEP_LIMIT`; the whole step is shortened."""
        largest = step[:, : self.reported].abs().amax(dim=1, keepdim=True)
        return step * (_STEP_LIMIT / largest.clamp_min(_STEP_LIMIT))

    def _identifiable(self, found: Tensor, std: Tensor) -> tuple[Tensor, FloatArray]:
        """Which unknowns are identified, (B, U), and the share that noise of the inputs has in the information, (B,).

        found: unknowns of every window; std: their standard deviations.
        """
        w, P = self.windows, len(self.windows.system.parameters)
        identifiable = std < IDENTIFIABLE_STD
        share, weak = np.zeros(len(found)), (std[:, :P] > WEAK_STD).any(dim=1).nonzero().squeeze(1)
        if len(weak):
            chosen = self.data.take(weak)
            noise = noise_share(w.model, w.model.linearise(found[weak][:, w.linear], chosen), chosen)
            identifiable[weak, :P] &= noise[:, :P] < NOISE_SHARE
            share[weak.numpy()] = mean_share(noise[:, :P])
        return identifiable, share

    def _result(self, states: bool) -> Refined:
        w, data = self.windows, self.data
        found, covariance = (
            self.point.unknowns[:, : self.reported],
            self.covariance[:, : self.reported, : self.reported],
        )
        identifiable, share = self._identifiable(found, torch.diagonal(covariance, dim1=1, dim2=2).sqrt())
        signals = len(w.model.compression.matrix(data.present))
        taken = self.states.shape[2] + len(w.memories) + identifiable.sum(dim=1)
        freedom = 2 * w.model.band.bins * signals - taken
        chi_square = self.cost / freedom.clamp_min(1)
        covariance = covariance * chi_square.clamp_min(1)[:, None, None]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.eye(self.reported, dtype=torch.float64) * PRIOR_STD**2
        prior[w.linear, w.linear] = 1 / w.model.precision[: len(w.linear)]
        B, ended = len(found), ~self.converged & self.work.ended
        diverged = (self.diverged | ~self.cost.isfinite()) & ~self.converged & ~ended
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
            excitation=np.full(B, np.inf),  # computed from the windows by the caller
            weighed=self.weighed.numpy(),
            cross=torch.where(identifiable[:, :, None], self.cross, 0.0).numpy(),
            information=(self.information / chi_square.clamp_min(1)[:, None, None]).numpy(),
            score=(self.score / chi_square.clamp_min(1)[:, None]).numpy(),
            noise=share,
            diverged=diverged.numpy(),
            ended=ended.numpy(),
        )
