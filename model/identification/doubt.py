"""What masses that are not quite those of the system file leave open of the parameters.

A window does not tell an axle that is heavier from one whose springs are softer: only with the scale of all forces,
which nothing but masses gives.  What it says of a mass beyond that hangs on delays of microseconds.  So masses are
taken as stated, and their doubt is part of what is stated of the others: with the products A of Gauss-Newton summed
over windows of an average ride, what is estimated beside them, x, changes with the masses m by

    D = -(A_xx + prior)^-1 A_xm,        covariance of x from the masses: D diag(std^2) D'

To a tracker x are parameters, loads, and gains and delays of channels: a sensor that measures a force itself shows one
that is not that of the masses, and that is read as its gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sprung.model.identification.calibration import DeviationSensitivity
from sprung.model.identification.deviations import deviations
from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.gauss_newton import Linearisation, WindowBatch
from sprung.model.identification.linearise import PRIOR_STD, WindowModel
from sprung.model.schema import Load, MassValue, SystemFile
from sprung.model.signals import FloatArray
from sprung.model.system import System

_WINDOWS = 8  # of a simulated ride; sensitivities differ little between them


@dataclass(frozen=True, slots=True, eq=False)
class MassDoubt:
    """Covariances that doubtful masses give what is estimated."""

    parameters: FloatArray  # of the log-ratios, shape (P, P)
    deviations: FloatArray  # of gains, delays and loads, see `model.identification.deviations`, shape (H, H)

    @property
    def none(self) -> bool:
        """Whether no mass is in doubt."""
        return not self.parameters.any()


def mass_doubt(system: System, *, loads: bool, channels: bool = False) -> MassDoubt:
    """What the doubtful masses of a system leave open; `loads`, `channels`: with its loads, its gains and delays
    unknown, as a tracker takes them.

    Nothing where laws act or no input is measured: there masses are taken as stated.
    """
    P, H = len(system.tracked), len(deviations(system))
    none = MassDoubt(np.zeros((P, P)), np.zeros((H, H)))
    if not system.doubtful_masses or system.laws or system.on_track or not system.file.inputs:
        return none
    return _computed(system, loads, channels)


def _computed(system: System, loads: bool, channels: bool) -> MassDoubt:
    P, doubtful, stated = len(system.parameters), system.doubtful_masses, deviations(system)
    free = System(_with_masses(system.file, doubtful, [load.body for load in system.loads] if loads else []))
    model = WindowModel(free, system.window)
    runs = simulate_runs(free, np.zeros((_WINDOWS, len(free.parameters))), system.window, np.random.default_rng(0))
    X = len(model.simulator.loading) if loads else 0
    with torch.no_grad():
        sensors = np.ones(len(free.sensors), dtype=bool)
        data = model.batch(model.knots(runs.values), runs.values, sensors)
        found = model.linearise(torch.zeros(_WINDOWS, len(free.parameters) + X, dtype=torch.float64), data)
        measured = 2 * len(system.channels) if channels else 0
        information = _information(model, found, data, measured).sum(axis=0)
    names = [p.name for p in free.parameters]
    masses = [names.index(f"{body}.mass") for body in doubtful]
    others = [names.index(p.name) for p in system.parameters] + list(range(len(names), len(information)))
    of_loads = [term.std for term in model.simulator.loading.terms][:X]
    spread = np.array([PRIOR_STD] * P + of_loads + [d.std for d in stated[:measured]])
    own = information[np.ix_(others, others)] + np.diag(spread**-2.0)
    moved = -np.linalg.solve(own, information[np.ix_(others, masses)]) * np.array(list(doubtful.values()))
    C = len(system.channels)
    beside = np.zeros((len(stated), len(masses)))
    beside[:measured], beside[2 * C : 2 * C + X] = moved[P + X :], moved[P : P + X]
    return MassDoubt(moved[:P] @ moved[:P].T, beside @ beside.T)


def _information(model: WindowModel, at: Linearisation, data: WindowBatch, measured: int) -> FloatArray:
    """Of windows on parameters, loads and the first `measured` deviations, without priors, (B, U, U)."""
    inverse = np.linalg.inv(at.covariance.numpy())
    own = inverse - np.diag(model.precision[: inverse.shape[1]].numpy())
    if not measured:
        return np.asarray(own)
    sensitivity, second = DeviationSensitivity(model), model.chord(at, at.x, at.x0, data)
    shown = model.by_drive(at, sensitivity.motions(data), data)
    cross, profiled, _ = sensitivity.evidence(at, second, data, shown).numpy()
    cross, profiled = cross[:, :, :measured], profiled[:, :measured, :measured]
    across = -inverse @ cross
    return np.block([[own, across], [across.transpose(0, 2, 1), profiled + cross.transpose(0, 2, 1) @ inverse @ cross]])


def _with_masses(file: SystemFile, doubtful: dict[str, float], loads: list[str]) -> SystemFile:
    """The file with the doubtful masses among what is estimated, every other one fixed, and `loads` said to be such."""
    bodies = {}
    for name, body in file.bodies.items():
        known = body.mass.fixed or ("mass" not in file.estimate and name not in doubtful)
        update: dict[str, object] = {"mass": MassValue(value=body.mass.value, fixed=known)}
        if name in loads and body.load is None:
            update["load"] = Load()
        bodies[name] = body.model_copy(update=update)
    return file.model_copy(update={"bodies": bodies, "estimate": tuple(dict.fromkeys([*file.estimate, "mass"]))})
