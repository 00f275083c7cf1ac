"""The paper's train wheel suspension: 18 states, 12 observations, 16 inputs, 24 parameters, 100 Hz, 500 steps.

The nominal vehicle is the bundled Manchester system; inputs are track irregularities after ERRI B176 at each wheel.
The paper's data are of two kinds here: every trajectory with the same parameters (the paper's), and parameters that
change from trajectory to trajectory.  States are measured with noise of 1 % of their rms (the paper says only
"noise"), and their inputs are known, as the paper assumes; for the versions that read the 12 accelerometers both
they and the inputs have the noise of the system file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.alps.task import Range, Rollouts, Task
from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import FloatArray
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import System, load_system

STEPS = 500
TRAJECTORIES = 20
SPREAD = 0.5  # every parameter within nominal (1 +- SPREAD)
STATE_NOISE = 0.01  # of the rms of each state
_ARM = 1e5  # m


@dataclass(frozen=True)
class TrainData:
    """Trajectories of the train: R of them, T steps."""

    measured: Tensor  # states with noise, (R, T, 18)
    states: Tensor  # true states, (R, T, 18)
    known: Tensor  # true wheel displacements and velocities, (R, T, 16)
    knots: Tensor  # the same as measured
    observations: Tensor  # accelerometers with noise, (R, T, 12)
    log_ratio: Tensor  # truth, (R, 24)
    noise: Tensor  # standard deviation of each measured state, (18,)
    size: Tensor  # rms of each true state, (18,): the unit of errors of states in figures; no method sees it

    @property
    def training(self) -> slice:
        """Rows of the training trajectories, the first half."""
        return slice(len(self.states) // 2)

    def measured_size(self) -> Tensor:
        """rms of each measured state over the training trajectories (18,): units for methods that measure states."""
        return self.measured[self.training].square().mean((0, 1)).sqrt()

    def expected_size(self) -> Tensor:
        """rms of each state (18,) of the nominal vehicle on the training inputs: units where no state is measured."""
        simulator = LinearSimulator(load_system())
        knots = self.knots[self.training]
        nominal = torch.zeros(len(knots), self.log_ratio.shape[1], dtype=torch.float64)
        discrete = simulator.discretise(simulator.element_values(nominal))
        states = simulator.states(discrete, knots, knots.new_zeros(len(knots), self.states.shape[2]))
        return states.square().mean((0, 1)).sqrt()


def full_state_system(system: System, noise: FloatArray | None = None, known_inputs: bool = True) -> System:
    """The system with sensors that measure every state, in place of its own; `noise` per state (18,).

    `known_inputs`: without noise, as the paper assumes.

    A point one `_ARM` away moves by the arm times the angle, plus the centre's motion; with an arm this long the
    latter is nothing, and the sensor measures the angle with independent noise.
    """
    sensors: dict[str, dict[str, object]] = {}
    deviation = np.zeros(2 * system.mechanics.n) if noise is None else noise
    for kind in ("displacement", "velocity"):
        for name, body in system.file.bodies.items():
            x, y = body.position
            for place, point, arm in (
                ("heave", (x, y), 1.0),
                ("roll", (x, y + _ARM), _ARM),
                ("pitch", (x + _ARM, y), _ARM),
            ):
                sensors[f"{name}_{kind}_{place}"] = {
                    "kind": kind, "body": name, "position": point, "noise": arm * float(deviation[len(sensors)]),
                }  # fmt: skip
    content = system.file.model_dump(mode="json")
    content["sensors"] = sensors
    if known_inputs:
        for support in content["inputs"].values():
            for quantity in ("displacement", "velocity"):
                support[quantity]["noise"] = 0.0
    return System(type(system.file).model_validate(content))


def to_states(points: FloatArray) -> FloatArray:
    """Values of the sensors of `full_state_system` (..., 18) -> states (..., 18), both in the same order."""
    shaped = points.reshape(*points.shape[:-1], -1, 3)
    heave = shaped[..., :1]
    return np.concatenate([heave, (shaped[..., 1:] - heave) / _ARM], axis=-1).reshape(points.shape)


def to_points(states: FloatArray) -> FloatArray:
    """The inverse of `to_states`: states (..., 18) -> values of the sensors (..., 18)."""
    shaped = states.reshape(*states.shape[:-1], -1, 3)
    heave = shaped[..., :1]
    return np.concatenate([heave, heave + _ARM * shaped[..., 1:]], axis=-1).reshape(states.shape)


def generate(changing: bool, rng: np.random.Generator, trajectories: int = TRAJECTORIES) -> TrainData:
    """Draw trajectories; `changing`: parameters drawn for each within +-50 %, else drawn once for all."""
    system = load_system()
    draws = trajectories if changing else 1
    truth = np.log(rng.uniform(1 - SPREAD, 1 + SPREAD, (draws, len(system.parameters))))
    truth = np.repeat(truth, trajectories // draws, axis=0)
    seed = int(rng.integers(2**31))
    # the same track twice: once through the accelerometers, once through sensors of every state
    runs = simulate_runs(system, truth, STEPS, np.random.default_rng(seed))
    wide = simulate_runs(full_state_system(system), truth, STEPS, np.random.default_rng(seed))
    inputs = len(system.inputs)
    states = to_states(wide.clean[:, :, inputs:])
    size = np.sqrt((states**2).mean((0, 1)))
    noise = STATE_NOISE * size
    return TrainData(
        measured=torch.from_numpy(states + noise * rng.standard_normal(states.shape)),
        states=torch.from_numpy(states),
        known=torch.from_numpy(LinearSimulator(system).knots(runs.clean)),
        knots=torch.from_numpy(LinearSimulator(system).knots(runs.values)),
        observations=torch.from_numpy(runs.values[:, :, inputs:]),
        log_ratio=torch.from_numpy(truth),
        noise=torch.from_numpy(noise),
        size=torch.from_numpy(size),
    )


def smoothed(simulator: LinearSimulator, log_ratio: Tensor, measured: Tensor, inputs: Tensor, noise: Tensor) -> Tensor:
    """Simulated states (B, T, 18) from the start that fits the measured window best, given the parameters.

    The start enters linearly, x = free(start) + forced(inputs), so that it is found by least squares of the whole
    window (weights 1 / noise) where the first measured sample alone would bring its noise into every later one.  At
    that optimum the misfit does not change with the start, so gradients need not go through the least squares.
    """
    discrete = simulator.discretise(simulator.element_values(log_ratio))
    with torch.no_grad():
        batch, samples, size = measured.shape
        forced = simulator.states(discrete, inputs, measured.new_zeros(batch, size))
        eye = torch.eye(size, dtype=measured.dtype, device=measured.device).expand(batch, size, size)
        free = simulator.free_response(replace(discrete, C=eye), samples)  # (B, T, 18, 18)
        weighted = (free / noise[:, None]).flatten(1, 2) * noise  # columns in units of the noise of their start
        residual = ((measured - forced) / noise).flatten(1)
        normal = weighted.mT @ weighted
        start = torch.linalg.solve(normal, weighted.mT @ residual[..., None])[..., 0] * noise
    return simulator.states(discrete, inputs, start)


def train_task(data: TrainData, size: Tensor | None = None) -> Task:
    """The train as a task of the common networks; its parameters are log-ratios to nominal values.

    `size`: unit of each state (18,), that of the measured training states by default.
    """
    size = data.measured_size() if size is None else size
    system = load_system()
    simulator = LinearSimulator(system)

    def simulate(start: Tensor, log_ratio: Tensor, inputs: Tensor) -> Tensor:
        return simulator.states(simulator.discretise(simulator.element_values(log_ratio)), inputs, start)

    def sample(count: int, rng: np.random.Generator, bounds: Range) -> Rollouts:
        del bounds
        drawn = generate(True, rng, count)
        return Rollouts(drawn.states, drawn.knots, drawn.log_ratio)

    low, high = float(np.log(1 - SPREAD)), float(np.log(1 + SPREAD))
    count = len(system.parameters)
    dofs = system.mechanics.dofs
    return Task(
        name="train",
        sample_rate=system.sample_rate,
        states=(*dofs, *(f"{name} rate" for name in dofs)),
        angles=(),
        velocity_of=tuple((i + len(dofs), i) for i in range(len(dofs))),
        state_scale=tuple(float(v) for v in size),
        parameters=tuple(p.name for p in system.parameters),
        seen=Range((low,) * count, (high,) * count),
        unseen=Range((low,) * count, (high,) * count),
        below=Range((low,) * count, (high,) * count),
        inputs=data.knots.shape[2],
        simulate=simulate,
        sample=sample,
        align=lambda encoded, true: lambda states: states,
    )
