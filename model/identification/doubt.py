"""What masses that are not quite those of the system file leave open of the parameters.

A window does not tell an axle that is heavier from one whose springs are softer: only with the scale of all forces,
which nothing but masses gives.  What it says of a mass beyond that hangs on delays of microseconds.  So masses are
taken as stated, and their doubt is part of what is stated of the others: with the products A of Gauss-Newton summed
over windows of an average ride, parameters and loads x change with the masses m by

    D = -(A_xx + prior)^-1 A_xm,        covariance of x from the masses: D diag(std^2) D'
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.linearise import PRIOR_STD, WindowModel
from sprung.model.schema import Load, MassValue, SystemFile
from sprung.model.signals import FloatArray
from sprung.model.system import System

_WINDOWS = 8  # of a simulated ride; sensitivities differ little between them


@dataclass(frozen=True, slots=True, eq=False)
class MassDoubt:
    """Covariance that doubtful masses give log-ratios."""

    parameters: FloatArray  # shape (P, P)
    loads: FloatArray  # variance of the logarithms of the loads' masses, shape (L,)

    @property
    def none(self) -> bool:
        """Whether no mass is in doubt."""
        return not self.parameters.any()


def mass_doubt(system: System, *, loads: bool) -> MassDoubt:
    """What the doubtful masses of a system leave open; `loads`: with its loads unknown, as a tracker takes them.

    Nothing where laws act or no input is measured: there masses are taken as stated.
    """
    none = MassDoubt(np.zeros((len(system.tracked), len(system.tracked))), np.zeros(len(system.loads)))
    if not system.doubtful_masses or system.laws or system.on_track or not system.file.inputs:
        return none
    return _computed(system, loads)


def _computed(system: System, loads: bool) -> MassDoubt:
    P, doubtful = len(system.parameters), system.doubtful_masses
    free = System(_with_masses(system.file, doubtful, [load.body for load in system.loads] if loads else []))
    model = WindowModel(free, system.window)
    at = np.zeros((_WINDOWS, len(free.parameters)))
    runs = simulate_runs(free, at, system.window, np.random.default_rng(0))
    X = len(model.simulator.loading) if loads else 0
    with torch.no_grad():
        sensors = np.ones(len(free.sensors), dtype=bool)
        data = model.batch(model.knots(runs.values), runs.values, sensors)
        found = model.linearise(torch.zeros(_WINDOWS, len(free.parameters) + X, dtype=torch.float64), data)
    prior = np.diag(model.precision[: len(free.parameters) + X].numpy())
    information = (np.linalg.inv(found.covariance.numpy()) - prior).sum(axis=0)
    names = [p.name for p in free.parameters]
    masses = [names.index(f"{body}.mass") for body in doubtful]
    others = [names.index(p.name) for p in system.parameters] + list(range(len(names), len(names) + X))
    spread = np.array([PRIOR_STD] * P + [term.std for term in model.simulator.loading.terms][:X])
    own = information[np.ix_(others, others)] + np.diag(spread**-2.0)
    moved = -np.linalg.solve(own, information[np.ix_(others, masses)]) * np.array(list(doubtful.values()))
    covariance = moved @ moved.T
    by_load = np.diag(covariance)[P : P + len(system.loads)] if loads else np.zeros(len(system.loads))
    return MassDoubt(covariance[:P, :P], by_load)


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
