"""What masses that are not quite those of the system file leave open of the parameters.

A window does not tell an axle that is heavier from one whose springs are softer: only with the scale of all forces,
which nothing but masses gives.  What it says of a mass beyond that hangs on delays of microseconds.  So masses are
taken as stated, and their doubt is part of what is stated of the others: with the products A of Gauss-Newton summed
over windows of an average ride, what is estimated beside them, x, changes with the masses m by

    D = -(A_xx + prior)^-1 A_xm,        covariance of x from the masses: D diag(std^2) D'

To a tracker x are parameters, loads, and gains and delays of channels: a sensor that measures a force itself shows one
that is not that of the masses, and that is read as its gain.

Laws leave something open, too: a stop so stiff that its body bounces on it at a fifth of the sample rate is followed
between samples to some thousandths of its force only, and that is the same in every window.
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
from sprung.model.laws import ElementLaw
from sprung.model.schema import Load, MassValue, SystemFile
from sprung.model.signals import FloatArray
from sprung.model.system import System

_WINDOWS = 8  # of a simulated ride; sensitivities differ little between them


_BOUNCE = 4.0  # by (bounce / sample rate)^4, what a stiffness of a law errs; measured: 0.6 % at 0.195, none at 0.09


@dataclass(frozen=True, slots=True, eq=False)
class MassDoubt:
    """Covariances that doubtful masses, or laws between samples, give what is estimated."""

    parameters: FloatArray  # of the log-ratios, shape (P, P)
    deviations: FloatArray  # of gains, delays and loads, see `model.identification.deviations`, shape (H, H)

    @property
    def none(self) -> bool:
        """Whether nothing is in doubt."""
        return not self.parameters.any()


def mass_doubt(system: System, *, loads: bool, channels: bool = False) -> MassDoubt:
    """What the doubtful masses of a system leave open; `loads`, `channels`: with its loads, its gains and delays
    unknown, as a tracker takes them.

    Where laws act or no input is measured masses are taken as stated; of laws see `bounce_doubt`.
    """
    H = len(deviations(system))
    none = MassDoubt(np.diag(bounce_doubt(system)), np.zeros((H, H)))
    if not system.doubtful_masses or system.laws or system.on_track or not system.file.inputs:
        return none
    return _computed(system, loads, channels)


def bounce_doubt(system: System) -> FloatArray:
    """Variances of log-ratios (P,) that sampling leaves to stiffnesses of laws, by how fast bodies bounce on them."""
    mechanics, names = system.whole_system.mechanics, [p.name for p in system.tracked]
    found = np.zeros(len(names))
    for placed in system.laws:
        if not isinstance(placed.law, ElementLaw) or len(placed.places) > 1:
            continue
        element = system.elements.index(placed.location)
        mobility = float(mechanics.H[element] ** 2 @ (1 / mechanics.mass))  # 1/kg
        for spec, name, value in zip(placed.law.parameters, placed.names, placed.values, strict=True):
            if spec.unit == "N/m" and name in names:
                bounce = np.sqrt((mechanics.stiffness[element] + abs(value)) * mobility) / (2 * np.pi)
                found[names.index(name)] = (_BOUNCE * (bounce / system.sample_rate) ** 4) ** 2
    return found


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
