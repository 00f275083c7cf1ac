"""The estimation problem: one part of a recording, its noise, and the prediction of a model.

Residual of bin w:   r = y - Y(theta, terms, x0; u),   covariance  R = diag(s^2) + G S_u G^H,

with G from the measured inputs to the sensors and S_u the inputs' noise (`whitening`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.fit.memory import FitMemory
from sprung.model.diagnosis.record.signals import Noise, Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.harmonic_balance import TOLERANCE, LawForces
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray
from sprung.model.system import System
from sprung.model.work import WorkBudget

_ROUND = 0.01  # cost of one law evaluation, relative to the linearisation of a vehicle


@dataclass(frozen=True)
class SmoothedInputs:
    """Inputs corrected within their noise by the smoother."""

    part: Part
    force: FloatArray | None = None  # of the laws along the smoothed motion, (4N, m)
    settled: bool = True  # whether these and the motion agree


@dataclass(frozen=True)
class Problem:
    """One part of a recording with its noise, to be fitted."""

    system: System
    part: Part
    sensors: np.ndarray  # indices of the present sensors
    noise: Noise
    rules: Rules = RULES  # of all decisions about fits
    memory: FitMemory | None = None  # cache of fits
    work: WorkBudget | None = None  # budget of work; None: unlimited
    newton_allowed: bool = True  # whether Newton's method is tried where the harmonic balance does not converge

    @property
    def process_noise(self) -> bool:
        """Whether laws act along the smoothed motion, since unmeasured forces accompany a measured one."""
        return self.noise.process_noise

    @property
    def worked_out(self) -> bool:
        """Whether the budget of work is exhausted."""
        return self.work is not None and self.work.ended

    def count(self, evaluations: float) -> None:
        """Count evaluations of a law along the oversampled record as work."""
        if self.work is not None:
            self.work.add(_ROUND * evaluations * self.part.grid.samples)

    def forward(self, point: Point, inputs: SmoothedInputs | None = None, known: Plant | None = None) -> Forward:
        """The model at a point under the measured inputs, or under smoothed ones.

        known: plant of a nearby model, reused if equal.
        """
        part = self.part if inputs is None else inputs.part
        return Forward(
            self.system, part, self.sensors, point.theta, point.terms, point.warm_start, known, self.newton_allowed
        )

    def with_filters_anew(self, point: Point) -> Point:
        """A point with the states that the filters of its terms have here, which begin at none."""
        structure = self.forward(point).plant.structure
        state = np.pad(point.state[: structure.moving], (0, structure.states - structure.moving))
        return replace(point, state=state)

    def predict(
        self, point: Point, inputs: SmoothedInputs | None = None, known: Plant | None = None
    ) -> tuple[ComplexArray, Forward, LawForces | None]:
        """Shown sensor signals, (F, S), the model, and the forces of its laws."""
        forward = self.forward(point, inputs, known)
        forces = law_forces(forward, point, inputs)
        self.count(0 if forces is None else forces.evaluations)
        return self.shown(forward, forces), forward, forces

    def shown(self, forward: Forward, forces: LawForces | None) -> ComplexArray:
        """Shown sensor signals of a solution under the measured inputs, (F, S)."""
        plant, part = forward.plant, forward.part
        periodic = forward.linear_sensors
        polynomial = plant.polynomial_sensors(forward.polynomial[0], forward.support_polynomial)
        if part is not self.part:
            periodic = periodic + self._of_input_noise(forward)
        if forces is not None:
            periodic = periodic + forces.sensors
            still = np.zeros_like(part.support_polynomial)
            polynomial = polynomial + plant.polynomial_sensors(forces.motion, still, forces.line)
        return forward.shown(periodic, polynomial) + forward.of_body_loads()

    def driving(self, forward: Forward) -> Part:
        """The inputs along which faults of inputs act: measured ones; beside an unmeasured force those of the model.

        The residual's covariance then changes with the response, too.
        """
        return forward.part if self.process_noise else self.part

    def shown_of_smoothed(self, forward: Forward, spectrum: ComplexArray) -> ComplexArray:
        """Shown sensor signals of the smoothed motion, (F, S), from the residual (F, S) under the measured inputs."""
        return self.smoothed(forward, self.part.sensors - spectrum)

    def smoothed(self, forward: Forward, shown: ComplexArray) -> ComplexArray:
        """Shown sensor signals under the smoothed inputs, (F, S), from those under the measured inputs."""
        if forward.part is self.part:
            return shown
        return shown - self._of_input_noise(forward) * forward.sensor_factor

    def _of_input_noise(self, forward: Forward) -> ComplexArray:
        """Linear response of the sensors to measured less smoothed inputs, (F, S)."""
        part, smoothed = self.part, forward.part
        forces = part.force - smoothed.force
        forces[0] += (part.force_polynomial - smoothed.force_polynomial)[0] * np.sqrt(part.grid.samples)
        motion = (part.support - smoothed.support) / forward.support_gain
        return forward.plant.sensors(motion, forces / forward.force_faults[0])

    def free_columns(self, forward: Forward) -> ComplexArray:
        """Spectra of the shown free motion per state at the first sample, (F, S, 2n)."""
        return forward.plant.free_transforms(forward.free_rows_at_start())

    def free_motion(self, forward: Forward, state: FloatArray) -> ComplexArray:
        """Spectra of the shown free motion of a state at the first sample, (F, S)."""
        return forward.plant.free_transform(forward.free_rows_at_start(), state)


def law_forces(
    forward: Forward, point: Point, inputs: SmoothedInputs | None = None, tolerance: float = TOLERANCE
) -> LawForces | None:
    """Forces of the laws: along the smoothed motion if given, else of a free run."""
    if inputs is None or inputs.force is None:
        return forward.law_forces(point.state, tolerance)
    balance = forward.harmonic_balance(point.state)
    return None if balance is None else balance.solution(inputs.force, inputs.settled)
