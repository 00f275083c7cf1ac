"""Free-run simulation over the whole recording, judged on the part that no fit saw."""

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
from sprung.model.diagnosis.selection.evidence import process_gain
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System

_ROUNDS = 4  # of laws' forces and the state at the start
_SETTLED = 1e-4  # of the laws' forces
_MARCHED = 2  # of them, in which what does not settle is marched through time: then it starts from what that came to


@dataclass(frozen=True)
class FreeRun:
    """What a model says of the held-out part, running on from the part it was fitted to."""

    simulated: FloatArray  # (T, S), held-out samples
    measured: FloatArray  # (T, S)
    per_sensor: FloatArray  # rms(error) / rms(measured), (S,)
    point: Point  # the model, with its starting state over the whole recording

    @property
    def nrmse(self) -> float:
        return float(np.sqrt(np.mean(self.per_sensor**2)))


@dataclass(frozen=True)
class HeldOutComparison:
    """What the held-out part says of one fit against another."""

    gain: float  # by how much the second says more, as twice the log-likelihood ratio or alike
    apart: float  # distance of what they say, in units of noise
    scatter: float  # variance along it: noise, and what the parameters' own uncertainty adds to it at most
    chance: float = RULES.selection.refuted  # standard deviations that are no longer chance

    @property
    def refuted(self) -> bool:
        """Whether the second says less, and that is no chance.

        Were it true, its gain would scatter about apart^2 by 2 apart: the error of the first is then apart and noise.
        """
        found: bool = self.gain < min(0.0, self.apart**2 - self.chance * 2 * self.apart * np.sqrt(self.scatter))
        return found


@dataclass(frozen=True)
class HeldOut:
    """The whole recording, of which the first `split` samples were fitted."""

    system: System
    signals: Signals
    noise: Noise  # by which runs are judged
    split: int
    rules: Rules = RULES

    @cached_property
    def differentiated(self) -> BoolArray:
        """Sensors that are compared by their rates."""
        return drifting(self.system, self.signals.sensor_index)

    @cached_property
    def whole(self) -> Part:
        """The whole recording as it is simulated."""
        return transform(self.signals, self.noise)

    @cached_property
    def later(self) -> Part:
        """The held-out part as it is compared: positions that drift by their rates."""
        return transform(
            self.signals.part(self.split, self.signals.samples), self.noise, differentiated=self.differentiated
        )

    @property
    def grid(self) -> Grid:
        return self.later.grid

    @cached_property
    def tracked(self) -> Part:
        """The whole recording as it is followed: positions that drift by their rates."""
        return transform(self.signals, self.noise, differentiated=self.differentiated)

    @property
    def still(self) -> bool:
        """Whether the held-out part hardly moves, so that nothing can be judged on it."""
        first, later = (np.std(part, axis=0) for part in np.split(self.signals.sensors, [self.split]))
        return bool(np.all(later < self.rules.selection.still * first))

    def run(self, point: Point) -> FreeRun:
        """Simulate with the measured inputs from the state that the fitted part ends in."""
        return self._judged(*self._simulated(point))

    def runs(self, *points: Point) -> list[FreeRun]:
        """The same for several models, simulated beside each other."""
        return [self._judged(*simulated) for simulated in share(self._simulated, points, WORKERS)]

    @cached_property
    def _known(self) -> dict[int, tuple[Point, tuple[FloatArray, Point]]]:
        """What was simulated already, with its point, by the point's identity."""
        return {}

    def _simulated(self, point: Point) -> tuple[FloatArray, Point]:
        """Held-out samples (T, S), and the point with its starting state."""
        if id(point) not in self._known:
            self._known[id(point)] = point, self._simulate(point)
        return self._known[id(point)][1]

    def _simulate(self, point: Point) -> tuple[FloatArray, Point]:
        """The same, simulated anew.

        The periodic solution over the whole recording is another one than over the fitted part, so the free motion
        is fitted again, to the fitted part alone.
        """
        point, part = self._up_to_split(point)
        problem = Problem(self.system, part, self.signals.sensor_index, self.noise)
        state = np.zeros_like(point.state)
        trained = slice(0, self.split)
        weights = 1 / self.noise.sensors
        near, rest = (point.warm_start if problem.process_noise else ()), np.zeros_like(state)
        for number in range(2 if problem.process_noise else _ROUNDS):
            forward = problem.forward(replace(point, state=state, warm_start=near))
            shown, forces, rest = self._free_run(problem, forward, state, rest, number)
            near = warm_start_of(forces)
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
        return simulated[self.split :], replace(point, state=state, warm_start=near)

    def compare(self, before: Fit, after: Fit) -> HeldOutComparison:
        """Two fits on the held-out part.

        Where laws follow the sensors' motion, along that motion: unmeasured forces take a free run astray, however
        good the model.
        """
        if not before.noise.process_noise:
            first, second = self._residuals(*self.runs(before.point, after.point))
            gain = float(first @ first - second @ second)
        else:
            (first, first_log_det), (second, second_log_det) = self._followed(before), self._followed(after)
            logs = first_log_det, second_log_det
            gain = process_gain(first, second, self.later.sensors.shape[1], logs, self.rules.evidence)
        apart, scatter = float(np.linalg.norm(first - second)), self.signals.samples / self.split
        return HeldOutComparison(gain, apart, scatter, self.rules.selection.refuted)

    def _followed(self, fit: Fit) -> tuple[FloatArray, float]:
        """Whitened residual of the held-out part under a fit's own noise, and its log determinant."""
        problem = Problem(self.system, self.later, self.signals.sensor_index, fit.noise)
        point, working = along_measured_motion(problem, replace(fit.point, warm_start=()))
        shown, forward, _ = problem.predict(point, working.inputs)
        free = self.later.grid.forward(forward.free_rows() @ point.state)
        return working.whitener(self.later.sensors - shown - free, self.later), working.whitener.log_det

    def _up_to_split(self, point: Point) -> tuple[Point, Part]:
        """The inputs as measured, but where laws follow the sensors' motion up to the split: smoothed until there.

        With the point, whose warm start are then the laws' forces along that motion.
        """
        signals = self.signals
        follower = Problem(self.system, self.tracked, signals.sensor_index, self.noise)
        if not follower.process_noise:
            return point, self.whole
        point, working = along_measured_motion(follower, replace(point, warm_start=()))
        followed = follower.forward(point, working.inputs).part
        force = followed.grid.inverse(followed.force) + followed.grid.monomials @ followed.force_polynomial
        force[self.split :] = signals.force[self.split :]
        return point, transform(replace(signals, force=force), self.noise)

    def _free_run(
        self, problem: Problem, forward: Forward, state: FloatArray, rest: FloatArray, number: int
    ) -> tuple[ComplexArray, LawForces | None, FloatArray]:
        """Shown sensor signals (F, S) and the laws' forces of a run that is free from the split on, in one round.

        Forces that follow the sensors until there tell the state from which the run goes on in the next.  rest: what
        the state lacks of that beside which the laws' part begins at rest; it comes back as this round has it.
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
            if not forces.converged and not forward.plant.floats:  # those never forget
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
        """Errors of free runs, weighed by the noise as the model of the first one passes it on, each (2 F S,)."""
        problem = Problem(self.system, self.later, self.signals.sensor_index, self.noise)
        whitener = Whitener.of(problem.forward(runs[0].point), self.noise)
        residuals = []
        for run in runs:
            error = run.measured - run.simulated
            compared = np.where(self.later.differentiated, rate_of(error, self.grid), error)
            residuals.append(whitener(self.grid.forward(compared), self.later))
        return residuals

    def noise_rms(self, fit: Fit, noise: Noise) -> FloatArray:
        """Error that noise alone causes at each sensor: its own and that of the inputs through the model, (S,)."""
        problem = Problem(self.system, self.whole, self.signals.sensor_index, noise)
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
