"""Free-run simulation over the whole recording, judged on its held-out part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.chunks import WORKERS, share
from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import along_measured_motion
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.record.signals import Noise, Part, Signals, drifting, rate_of, transform
from sprung.model.diagnosis.record.spectra import ComplexArray, Grid
from sprung.model.diagnosis.response.forward import Forward, propagate
from sprung.model.diagnosis.response.harmonic_balance import LawForces, warm_start_of
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.time_stepping import march_from, march_from_rest
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.diagnosis.selection.evidence import process_gain, profile_gain
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System

_DIVERGED = 1e9  # samples of a run that leaves the range of numbers: worse than any that does not
_ROUNDS = 4  # of laws' forces and the state at the start
_SETTLED = 1e-4  # of the laws' forces
_MARCHED = 2  # of them, in which time stepping replaces a harmonic balance that does not converge


@dataclass(frozen=True)
class FreeRun:
    """Simulation of the held-out part by a model that continues from the fitted part."""

    simulated: FloatArray  # (T, S), held-out samples
    measured: FloatArray  # (T, S)
    per_sensor: FloatArray  # rms(error) / rms(measured), (S,)
    point: Point  # the model, with its starting state over the whole recording

    @property
    def nrmse(self) -> float:
        return float(np.sqrt(np.mean(self.per_sensor**2)))


@dataclass(frozen=True)
class HeldOutComparison:
    """Comparison of two fits on the held-out part."""

    gain: float  # of the second, as twice the log-likelihood ratio
    evidence: float  # the same, but no more than with the noise level of every block profiled out
    apart: float  # distance of the two predictions, in units of noise
    scatter: float  # variance along it: noise, and an upper bound of the effect of the parameters' uncertainty
    chance: float = RULES.selection.refuted  # standard deviations beyond which the difference is significant
    closer: bool = False  # whether the second is clearly closer to every sensor

    @property
    def refuted(self) -> bool:
        """Whether the second predicts significantly worse.

        If it were true, its gain would be distributed about apart^2 with standard deviation 2 apart.  Where both are
        far from noise, slow errors that are a small part of all weigh most: what is closer to all sensors is kept.
        """
        if self.closer:
            return False
        found: bool = self.gain < min(0.0, self.apart**2 - self.chance * 2 * self.apart * np.sqrt(self.scatter))
        return found


@dataclass(frozen=True)
class HeldOut:
    """The whole recording, of which the first `split` samples were fitted."""

    system: System
    signals: Signals
    noise: Noise  # that weights the errors of runs
    split: int
    rules: Rules = RULES

    @cached_property
    def differentiated(self) -> BoolArray:
        """Sensors that are compared by their rates."""
        return drifting(self.system, self.signals.sensor_index)

    @cached_property
    def whole(self) -> Part:
        """The whole recording, for simulation."""
        return transform(self.signals, self.noise, self.rules.record)

    @cached_property
    def later(self) -> Part:
        """The held-out part, for comparison: drifting positions are differentiated."""
        signals = self.signals.part(self.split, self.signals.samples)
        return transform(signals, self.noise, self.rules.record, differentiated=self.differentiated)

    @property
    def grid(self) -> Grid:
        return self.later.grid

    @cached_property
    def tracked(self) -> Part:
        """The whole recording, for smoothing: drifting positions are differentiated."""
        return transform(self.signals, self.noise, self.rules.record, differentiated=self.differentiated)

    @property
    def still(self) -> bool:
        """Whether the held-out part hardly moves, so that it cannot validate anything."""
        first, later = (np.std(part, axis=0) for part in np.split(self.signals.sensors, [self.split]))
        return bool(np.all(later < self.rules.selection.still * first))

    def run(self, point: Point) -> FreeRun:
        """Simulate the held-out part under the measured inputs, continuing from the fitted part."""
        return self._judged(*self._simulated(point))

    def runs(self, *points: Point) -> list[FreeRun]:
        """The same for several models, in parallel."""
        return [self._judged(*simulated) for simulated in share(self._simulated, points, WORKERS)]

    @cached_property
    def _known(self) -> dict[int, tuple[Point, tuple[FloatArray, Point]]]:
        """Cached simulations with their points, by the identity of the point."""
        return {}

    def _simulated(self, point: Point) -> tuple[FloatArray, Point]:
        """Held-out samples (T, S), and the point with its starting state."""
        if id(point) not in self._known:
            try:
                simulated = self._simulate(point)
            except (np.linalg.LinAlgError, FloatingPointError):
                simulated = np.full_like(self.signals.sensors[self.split :], _DIVERGED), point
            self._known[id(point)] = point, simulated
        return self._known[id(point)][1]

    def _simulate(self, point: Point) -> tuple[FloatArray, Point]:
        """The same without the cache.

        The periodic solution over the whole recording differs from that over the fitted part, so the free motion is
        fitted anew, to the fitted part only.
        """
        point, part = self._up_to_split(point)
        problem = Problem(self.system, part, self.signals.sensor_index, self.noise, self.rules)
        state = np.zeros_like(point.state)
        trained = slice(0, self.split)
        weights = 1 / self.noise.sensors
        warm_start, rest = (point.warm_start if problem.process_noise else ()), np.zeros_like(state)
        for number in range(2 if problem.process_noise else _ROUNDS):
            forward = problem.forward(replace(point, state=state, warm_start=warm_start))
            shown, forces, rest = self._free_run(problem, forward, state, rest, number)
            warm_start = warm_start_of(forces)
            rows = forward.free_rows_at_start()
            free = forward.plant.free_motion(rows, part.grid.step, self.split)
            particular = part.grid.inverse(shown)
            target = (self.signals.sensors[trained] - particular[trained]) * weights
            normal, right = _normal(free, target, weights)
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
            solved = np.linalg.lstsq(normal * scale * scale[:, None], right * scale, rcond=1e-12)[0] * scale
            moved = float(np.max(np.abs(solved - state) / np.maximum(np.abs(solved), 1e-12)))
            state = solved
            if forces is None or (moved < 1e-3 and not problem.process_noise):
                break
        A = forward.plant.structure.state_matrix()
        simulated = particular + propagate(A, rows, state, part.grid.step, self.signals.samples)
        return simulated[self.split :], replace(point, state=state, warm_start=warm_start)

    def compare(self, before: Fit, after: Fit) -> HeldOutComparison:
        """Two fits on the held-out part.

        With process noise, along the measured motion: unmeasured forces make any free run diverge from the measurement.
        """
        closer = False
        if not before.noise.process_noise:
            runs = self.runs(before.point, after.point)
            first, second = self._residuals(*runs)
            gain = float(first @ first - second @ second)
            evidence = min(gain, self._profile_gain(first, second))
            closer = bool(np.all(runs[1].per_sensor < self.rules.selection.closer * runs[0].per_sensor))
        else:
            (first, first_log_det), (second, second_log_det) = self._followed(before), self._followed(after)
            logs = first_log_det, second_log_det
            gain = evidence = process_gain(first, second, self.later.sensors.shape[1], logs, self.rules.evidence)
        apart, scatter = float(np.linalg.norm(first - second)), self.signals.samples / self.split
        return HeldOutComparison(gain, evidence, apart, scatter, self.rules.selection.refuted, closer)

    def _profile_gain(self, before: FloatArray, after: FloatArray) -> float:
        """Gain of one whitened residual over another, noise levels unknown."""
        rules = self.rules.evidence
        return profile_gain(before, after, self.later.sensors.shape[1], rules.quiet, rules)

    def _followed(self, fit: Fit) -> tuple[FloatArray, float]:
        """Whitened residual of the held-out part along the smoothed motion, and its log determinant."""
        problem = Problem(self.system, self.later, self.signals.sensor_index, fit.noise, self.rules)
        point, working = along_measured_motion(problem, replace(fit.point, warm_start=()))
        shown, forward, _ = problem.predict(point, working.inputs)
        free = self.later.grid.forward(forward.free_rows() @ point.state)
        return working.whitener(self.later.sensors - shown - free, self.later), working.whitener.log_det

    def _up_to_split(self, point: Point) -> tuple[Point, Part]:
        """The measured inputs, with process noise smoothed up to the split; and the point.

        Its warm start then holds the laws' forces along the smoothed motion.
        """
        signals = self.signals
        follower = Problem(self.system, self.tracked, signals.sensor_index, self.noise, self.rules)
        if not follower.process_noise:
            return point, self.whole
        point, working = along_measured_motion(follower, replace(point, warm_start=()))
        followed = follower.forward(point, working.inputs).part
        force = followed.grid.inverse(followed.force) + followed.grid.monomials @ followed.force_polynomial
        force[self.split :] = signals.force[self.split :]
        return point, transform(replace(signals, force=force), self.noise, self.rules.record)

    def _free_run(
        self, problem: Problem, forward: Forward, state: FloatArray, rest: FloatArray, number: int
    ) -> tuple[ComplexArray, LawForces | None, FloatArray]:
        """One round: shown sensor signals (F, S) and laws' forces of a run that is free from the split on.

        Forces along the measured motion up to the split determine the state from which the next round continues.
        rest: offset of the state (2n + b,) for laws' responses that begin at rest; returned as of this round.
        """
        balance = forward.harmonic_balance(state)
        if balance is None:
            return problem.shown(forward, None), None, rest
        forces: LawForces | None
        if problem.process_noise:
            known = np.column_stack(forward.warm_start)
            forces = balance.solution(march_from(forward, state, self.split) if number else known)
        else:
            forces = forward.law_forces(state, _SETTLED)
            assert forces is not None
            if not forces.converged and not forward.plant.floats:  # unconstrained systems have no fading memory
                if number < _MARCHED:
                    force, rest = march_from_rest(forward, state + rest)
                else:
                    force = np.column_stack(forward.warm_start)
                forces = balance.solution(force)
        return problem.shown(forward, forces), forces, rest

    def _judged(self, simulated: FloatArray, point: Point) -> FreeRun:
        measured = self.signals.sensors[self.split :]
        size = np.sqrt(np.mean(measured**2, axis=0))
        per_sensor = np.sqrt(np.mean((measured - simulated) ** 2, axis=0)) / np.where(size > 0, size, 1.0)
        return FreeRun(simulated, measured, per_sensor, point)

    def _residuals(self, *runs: FreeRun) -> list[FloatArray]:
        """Errors of free runs, whitened by the noise through the first model, each (2 F S,)."""
        problem = Problem(self.system, self.later, self.signals.sensor_index, self.noise, self.rules)
        whitener = Whitener.of(problem.forward(runs[0].point), self.noise)
        residuals = []
        for run in runs:
            error = run.measured - run.simulated
            compared = np.where(self.later.differentiated, rate_of(error, self.grid, self.rules.record), error)
            residuals.append(whitener(self.grid.forward(compared), self.later))
        return residuals

    def noise_rms(self, fit: Fit, noise: Noise) -> FloatArray:
        """Error that noise alone causes at each sensor: its own and that of the inputs through the model, (S,)."""
        problem = Problem(self.system, self.whole, self.signals.sensor_index, noise, self.rules)
        plant = problem.forward(fit.point).plant
        variance = noise.support_variance(self.whole.grid.omega)
        power = np.einsum("fsi,fi->fs", np.abs(plant.sensor_of_support) ** 2, variance)
        power = power + np.abs(plant.sensor_of_measured_force) ** 2 @ noise.force**2
        found: FloatArray = np.sqrt(power.mean(axis=0) + noise.sensors**2)
        return found


def _normal(free: FloatArray, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations of target (N, S) = weights * free (N, S, 2n) @ state."""
    columns = (free * weights[None, :, None]).reshape(-1, free.shape[2])
    return columns.T @ columns, columns.T @ target.ravel()
