"""Free-run simulation over the whole recording, judged on the part that no fit saw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.diagnosis.fit import Fit, Problem
from model.diagnosis.forward import propagate
from model.diagnosis.march import march_forces
from model.diagnosis.measured import Noise, Part, Signals, drifting, rate_of, transform
from model.diagnosis.point import Point
from model.diagnosis.spectra import Grid
from model.diagnosis.whiten import Whitener
from model.signals import FloatArray
from model.system import System


@dataclass(frozen=True)
class FreeRun:
    """What a model says of the held-out part, running on from the part it was fitted to."""

    simulated: FloatArray  # (T, S), held-out samples
    measured: FloatArray  # (T, S)
    chi_square: float  # whitened, of the held-out residual
    count: int
    per_sensor: FloatArray  # rms(error) / rms(measured), (S,)
    point: Point  # the model, with its starting state over the whole recording

    @property
    def nrmse(self) -> float:
        return float(np.sqrt(np.mean(self.per_sensor**2)))


class HeldOut:
    """The whole recording, of which the first `split` samples were fitted."""

    def __init__(self, system: System, signals: Signals, noise: Noise, split: int) -> None:
        self.system, self.signals, self.noise, self.split = system, signals, noise, split
        self.whole = transform(signals, noise)
        self.grid = Grid(signals.samples - split, 1 / signals.sample_rate, split / signals.sample_rate)
        self.whitener: Whitener | None = None
        self.later: Part | None = None

    def run(self, point: Point) -> FreeRun:
        """Simulate with the measured inputs from the state that the fitted part ends in.

        The periodic solution over the whole recording is another one than over the fitted part, so the free motion
        is fitted again, to the fitted part alone.
        """
        problem = Problem(self.system, self.whole, self.signals.sensor_index, self.noise)
        state = np.zeros_like(point.state)
        trained = slice(0, self.split)
        weights = 1 / self.noise.sensors
        waveform = None
        for _ in range(4):
            now = Point(point.theta, point.terms, state)
            shown, forward, forces = problem.predict(now, waveform or ())
            if forces is not None and not forces.converged and not forward.plant.floats:  # those never forget
                shown, forward, forces = problem.predict(now, march_forces(forward, state))
            waveform = None if forces is None else tuple(forces.force.T)
            rows = forward.free_rows_at_start()
            free = forward.plant.free_motion(rows, self.whole.grid.step, self.split)
            particular = self.whole.grid.inverse(shown)
            target = (self.signals.sensors[trained] - particular[trained]) * weights
            normal, right = _normal(free, target, weights)
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
            solved = np.linalg.lstsq(normal * scale * scale[:, None], right * scale, rcond=1e-12)[0] * scale
            moved = float(np.max(np.abs(solved - state) / np.maximum(np.abs(solved), 1e-12)))
            state = solved
            if forces is None or moved < 1e-3:
                break
        A = forward.plant.structure.state_matrix()
        simulated = particular + propagate(A, rows, state, self.whole.grid.step, self.signals.samples)
        return self._judge(simulated[self.split :], replace(point, state=state, near=waveform or ()))

    def _judge(self, simulated: FloatArray, point: Point) -> FreeRun:
        measured = self.signals.sensors[self.split :]
        error = measured - simulated
        if self.later is None:
            part = self.signals.part(self.split, self.signals.samples)
            self.later = transform(part, self.noise, rated=drifting(self.system, self.signals.sensor_index))
        if self.whitener is None or len(self.noise.force):
            problem = Problem(self.system, self.later, self.signals.sensor_index, self.noise)
            self.whitener = Whitener.of(problem.forward(point), self.noise)
        compared = np.where(self.later.rated, rate_of(error, self.grid), error)
        residual = self.whitener(self.grid.forward(compared), self.later)
        size = np.sqrt(np.mean(measured**2, axis=0))
        per_sensor = np.sqrt(np.mean(error**2, axis=0)) / np.where(size > 0, size, 1.0)
        return FreeRun(simulated, measured, float(residual @ residual), len(residual), per_sensor, point)

    def noise_rms(self, fit: Fit, noise: Noise) -> FloatArray:
        """Error that noise alone causes at each sensor: its own and that of the inputs through the model, (S,)."""
        problem = Problem(self.system, self.whole, self.signals.sensor_index, noise)
        plant = problem.forward(fit.point).plant
        variance = noise.support_variance(self.whole.grid.omega)
        power = np.einsum("fsi,fi->fs", np.abs(plant.sensor_of_support) ** 2, variance)
        power = power + np.abs(plant.sensor_of_measured_force) ** 2 @ noise.force**2
        return np.sqrt(power.mean(axis=0) + noise.sensors**2)


def _normal(free: FloatArray, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations of target (N, S) = weights * free (N, S, 2n) @ state."""
    columns = (free * weights[None, :, None]).reshape(-1, free.shape[2])
    return columns.T @ columns, columns.T @ target.ravel()
