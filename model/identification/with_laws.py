"""Windows of a system whose file has laws: maximum likelihood with the non-linear model inside.

Gauss-Newton as in `model.identification.refine`, with columns from forward sensitivities along the window's own motion
(`model.identification.law_window`).  Beside the linear parameters the laws' values that are not fixed are estimated, as
logarithms of ratios to the file, and the memories at the first sample, which no window knows beforehand.  One
iteration is a linearisation and a step; the model is brought to its own motion again at the new point, and the old
products give a second step.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.chunks import alike, share
from sprung.model.identification.estimates import estimates
from sprung.model.identification.gauss_newton import WindowBatch
from sprung.model.identification.law_forces import Acting
from sprung.model.identification.law_point import Moved, WindowPoint
from sprung.model.identification.law_window import LawWindows
from sprung.model.identification.linearise import PRIOR_STD, WindowModel
from sprung.model.identification.refine import IDENTIFIABLE_STD, NOISE_SHARE, WEAK_STD, Refined, in_order
from sprung.model.identifier import StageTimes, UnusableWindow
from sprung.model.laws import ElementLaw
from sprung.model.signals import BoolArray, Estimate, FloatArray, IntArray
from sprung.model.system import System

ITERATIONS = 6
_CHUNK = 96  # windows at a time
_FITS = 1.5  # chi-square of a window that stands where it belongs, generously
_ENOUGH = 3  # such windows tell where those of a batch that went astray should begin
_OPENING = 1  # rounds of forces and first state before the first iteration
_CONVERGED = 0.3  # a second step this small, in standard deviations, leaves an error far below it
_STILL = 0.3  # a first step this small: the window stands at its minimum, whatever the second one says
_SLACK = 2.0  # of chi-square, by which a step may be worse: neither forces nor smoothed inputs settle closer
_STEP_LIMIT = 0.7  # largest change of a log-ratio in one step


def acting_laws(system: System) -> list[Acting]:
    """The laws that windows are identified with.  Errors: `UnusableWindow` for one that no window can hold."""
    found = []
    for placed in system.laws:
        law = placed.law
        if law.name.startswith("sensor_"):
            continue  # undone in the signals
        if not isinstance(law, ElementLaw) or law.memory > 1 or law.name.startswith("time_varying"):
            raise UnusableWindow(
                f"{placed.location}: windows cannot be identified with {law.name} in place; "
                "diagnose, simulate and compare can use it"
            )
        at = [system.elements.index(name) for name in placed.places]
        for group in [at] if law.where == "pair" else [[e] for e in at]:
            weights = np.zeros(len(system.elements))
            weights[group[0]] = 1.0
            if len(group) == 2:
                weights[group[1]] = -1.0
            free = tuple(i for i, (v, f) in enumerate(zip(placed.values, placed.fixed, strict=True)) if v > 0 and not f)
            found.append(Acting(placed, law, weights, group[0], free))
    return found


def without_laws(system: System) -> System:
    """The system without the laws of its elements."""
    bare = {name: element.model_copy(update={"laws": ()}) for name, element in system.file.elements.items()}
    return System(system.file.model_copy(update={"elements": bare}), system.catalogue)


@dataclass(slots=True)
class IdentifierWithLaws:
    """Identifies windows of one system with laws; parameters are `system.tracked`."""

    system: System
    laws: list[Acting]
    workers: int = 1
    times: StageTimes = field(default_factory=StageTimes)
    _windows: dict[int, LawWindows] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Names the model that made an estimate."""
        return self.system.digest

    def identify(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> list[Estimate]:
        """One `Estimate` per window over `system.tracked`; see `model.identifier.Identifies`."""
        begin = time.perf_counter()
        windows = self._checked(windows)
        if len(windows) == 0:
            return []
        refined = self.refine(windows, start, states=states)
        found = estimates(refined, len(self.system.tracked), states, [None] * len(windows))
        self.times = StageTimes(0.0, time.perf_counter() - begin)
        return found

    def refine(self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False) -> Refined:
        """Maximum likelihood from log-ratios `start` (B, P), those of the file by default; windows as checked."""
        model = self._model(windows.shape[1])
        present: BoolArray = ~np.asarray(np.isnan(windows[:, :, len(self.system.inputs) :]).any(axis=1))
        begin = np.zeros((len(windows), len(self.system.tracked)))
        if start is not None:
            begin[:, : start.shape[1]] = start

        def work(at: IntArray) -> Refined:
            with torch.no_grad():
                knots = model.model.knots(windows[at])
                data = model.model.batch(knots, windows[at], present[at[0]])
                found = _Search(model, data, begin[at]).run(states, near)
                return replace(found, excitation=model.model.excitation(windows[at]))

        def over(of: IntArray) -> Refined:
            pieces = [
                np.asarray(part)
                for group in alike(present, of)
                for part in np.array_split(group, max(1, -(-len(group) // _CHUNK)))
            ]
            return in_order(share(work, pieces, self.workers), np.concatenate(pieces))

        near = start is not None
        found = over(np.arange(len(windows)))
        good = found.converged & (found.chi_square < _FITS)
        bad = np.flatnonzero(~good)
        if len(bad) and good.sum() >= _ENOUGH:  # the others say where to begin
            near = True
            begin[bad] = np.median(found.log_ratio[good], axis=0)
            again = over(bad)
            better = again.chi_square < found.chi_square[bad]
            found = found.replaced(bad[better], again.take(np.flatnonzero(better)))
        return found

    def _model(self, samples: int) -> LawWindows:
        if samples not in self._windows:
            bare = without_laws(self.system)
            self._windows[samples] = LawWindows(bare, self.laws, WindowModel(bare, samples))
        return self._windows[samples]

    def _checked(self, windows: FloatArray) -> FloatArray:
        windows = np.asarray(windows, dtype=np.float64)
        channels = self.system.channels
        if windows.ndim != 3 or windows.shape[2] != len(channels):
            raise UnusableWindow(f"windows: shape (B, T, {len(channels)}) expected, {windows.shape} came")
        inputs = windows[:, :, : len(self.system.inputs)]
        for column in np.flatnonzero(~np.isfinite(inputs).all(axis=(0, 1))):
            raise UnusableWindow(f"{channels[column].name}: input is missing or not finite; every input is needed")
        if np.isinf(windows).any():
            raise UnusableWindow(f"{channels[int(np.argwhere(np.isinf(windows))[0][2])].name}: not finite")
        return windows


class _Search:
    """Gauss-Newton on windows with the same sensors present, from log-ratios (B, P + laws' values)."""

    def __init__(self, windows: LawWindows, data: WindowBatch, start: FloatArray) -> None:
        self.windows, self.data = windows, data
        B, U, T, N = len(start), windows.unknowns, windows.model.samples, windows.model.states_count
        self.told = start.shape[1]  # log-ratios; memories follow
        unknowns = torch.zeros(B, U, dtype=torch.float64)
        unknowns[:, : self.told] = torch.as_tensor(start)
        zero = torch.zeros(B, N, dtype=torch.float64)
        self.point = WindowPoint(unknowns, zero, torch.zeros(B, T, len(windows.acting), dtype=torch.float64))
        self.best = self.point.take(torch.arange(B))
        self.cost = torch.full((B,), torch.inf, dtype=torch.float64)
        self.covariance = torch.eye(U, dtype=torch.float64).repeat(B, 1, 1)
        self.converged = torch.zeros(B, dtype=torch.bool)
        self.iterations = torch.zeros(B, dtype=torch.long)
        self.error = torch.full((B, len(data.present)), torch.nan, dtype=torch.float64)
        self.states = torch.zeros(B, T, N, dtype=torch.float64)
        self.outputs = torch.full((B, T, len(data.present)), torch.nan, dtype=torch.float64)
        self.smooth = np.zeros((2, B, T, len(windows.system.elements)))

    def run(self, states: bool, near: bool = False) -> Refined:
        """Iterate until every window has converged, or `ITERATIONS` times; near: the start is no guess."""
        self._open(near)
        active = torch.arange(len(self.cost))
        for _ in range(ITERATIONS):
            self._iterate(active)
            active = active[~self.converged[active]]
            if len(active) == 0:
                break
        return self._result(states)

    def _open(self, near: bool) -> None:
        """Linear fits with the laws' forces as given, and forces along their motion, which follows the sensors.

        near: the values go back to the start then, and only the first states and forces stay.
        """
        w, data, P = self.windows, self.data, len(self.windows.system.parameters)
        start = self.point
        at = w.model.linearise(start.unknowns[:, :P], data)
        step = self._limited(at.step)
        point = self._linear_step(start, step, at.state_after(step))
        for last in (False,) * _OPENING + (True,) * near:
            point = replace(point, unknowns=start.unknowns) if last else point
            steps = w.steps(point, data)
            if not last:
                states, _ = w.simulate(steps, point.force, point.x0, data)
                point = replace(point, force=w.forces(point, steps, states, data, self.smooth))
            residual = w.residual(Moved(*w.simulate(steps, point.force, point.x0, data)), data, at.whiten)
            along = at.free @ residual
            alone = torch.cholesky_solve(along, at.factor)
            gradient = at.sensitivities @ residual - at.across.mT @ along
            step = self._limited((at.covariance @ gradient).squeeze(2)) * (not last)
            dx0 = (alone - at.across @ step.unsqueeze(2)).squeeze(2) / at.free_scale
            point = self._linear_step(point, step, point.x0 + dx0)
        self.point = point

    def _linear_step(self, point: WindowPoint, step: Tensor, x0: Tensor) -> WindowPoint:
        unknowns = point.unknowns.clone()
        unknowns[:, : step.shape[1]] += step
        return replace(point, unknowns=unknowns, x0=x0)

    def _iterate(self, rows: Tensor) -> None:
        """A linearisation and two steps of the windows `rows`; a point that is worse is taken back to a third."""
        w, data, smooth = self.windows, self.data.take(rows), self.smooth[:, rows.numpy()]
        point, before = self.point.take(rows), self.cost[rows]
        steps = w.steps(point, data)
        point, motion = w.settle(point, steps, data, smooth)
        flow = w.flow(point, steps, motion, data, smooth)
        columns = w.columns(point, steps, motion, data, smooth, flow)
        residual = w.residual(motion, data, columns.whiten)
        cost, step, alone = columns.solve(residual, point.unknowns)
        worse = ~(cost <= before * (1 + 1e-6) + _SLACK)
        step = self._limited(step)
        dx0 = columns.state_step(alone, step)
        smooth = w.smoothed(columns, residual, step, dx0, steps)
        there = point.moved(step, dx0)
        steps = w.steps(there, data)
        there, motion = w.settle(there, steps, data, smooth, flow)
        second, more, alone = columns.solve(w.residual(motion, data, columns.whiten), there.unknowns)
        held = second <= cost * (1 + 1e-6) + _SLACK
        std = torch.diagonal(columns.covariance, dim1=1, dim2=2).sqrt()
        small = (more.abs() / std).amax(dim=1) < _CONVERGED
        still = (step.abs() / std).amax(dim=1) < _STILL
        done = ((small & held) | still) & ~worse
        more = self._limited(more)
        forward = there.moved(more, columns.state_step(alone, more)).where(held, point.moved(step / 3, dx0 / 3))
        best = self.best.take(rows)
        self.point.put(rows, best.towards(point, 1 / 3).where(worse, forward))
        self.best.put(rows, best.where(worse, point))
        self.cost[rows] = torch.where(done & held, second, torch.where(worse, before, cost))
        self.smooth[:, rows.numpy()] = smooth
        self.converged[rows], self.covariance[rows], self.states[rows] = done, columns.covariance, motion.states
        self.iterations[rows] += 1
        shown = torch.as_tensor(np.flatnonzero(data.present))
        self.outputs[rows[:, None], :, shown] = motion.outputs.mT
        self.error[rows[:, None], shown] = (data.measured - motion.outputs).square().mean(dim=1).sqrt()

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
        weak = (std[:, :P] > WEAK_STD).any(dim=1).nonzero().squeeze(1)
        if len(weak):
            chosen = data.take(weak)
            noise = w.model.noise_share(w.model.linearise(found[weak, :P], chosen), chosen)
            identifiable[weak, :P] &= noise < NOISE_SHARE
        signals = len(w.model.compression.matrix(data.present))
        taken = self.states.shape[2] + len(w.memories) + identifiable.sum(dim=1)
        freedom = 2 * w.model.bins * signals - taken
        chi_square = self.cost / freedom.clamp_min(1)
        covariance = covariance * chi_square.clamp_min(1)[:, None, None]
        both = identifiable[:, :, None] & identifiable[:, None, :]
        prior = torch.eye(self.told, dtype=torch.float64) * PRIOR_STD**2
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
            weighed=np.zeros(B, dtype=bool),
            cross=np.zeros((B, self.told, 0)),
            information=np.zeros((B, 0, 0)),
            score=np.zeros((B, 0)),
        )
