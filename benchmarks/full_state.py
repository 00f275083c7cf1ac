"""Other sensing for the Manchester vehicle than its system file has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.identification.excitation import Runs
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.mechanics import DISPLACEMENT, VELOCITY
from sprung.model.schema import MotionSensor
from sprung.model.signals import FloatArray
from sprung.model.system import System, load_system


def full_state_system(typical: Runs, share: float) -> System:
    """The vehicle with all 18 states measured, each with noise of `share` of its rms over `typical` runs.

    Inputs are known.  States are sensors on degrees of freedom, which no system file can say (a roll angle is no
    vertical motion of a point), so the mechanics is put in place by hand.
    """
    base = load_system()
    states = _states(base, typical)
    noise = share * np.sqrt((states**2).mean(axis=(0, 1)))
    names = [f"{dof}-{kind}".replace(".", "_") for kind in ("displacement", "velocity") for dof in base.mechanics.dofs]
    sensors = {
        name: MotionSensor(kind="displacement" if i < 9 else "velocity", body="car", noise=float(noise[i]))
        for i, name in enumerate(names)
    }
    inputs = {
        name: source.model_copy(
            update={
                part: getattr(source, part).model_copy(update={"noise": 0.0}) for part in ("displacement", "velocity")
            }
        )
        for name, source in base.file.inputs.items()
    }
    system = System(base.file.model_copy(update={"sensors": sensors, "inputs": inputs}))
    n = base.mechanics.n
    mechanics = replace(
        base.mechanics,
        S=np.concatenate([np.eye(n), np.eye(n)]),
        L=np.zeros((2 * n, len(base.elements))),
        sensor_kind=np.array([DISPLACEMENT] * n + [VELOCITY] * n),
    )
    system.__dict__["mechanics"] = mechanics
    return system


def _states(system: System, runs: Runs) -> FloatArray:
    """States of clean runs, (B, T, N)."""
    refiner = Refiner(system, runs.clean.shape[1])
    return refiner.refine(runs.clean, runs.log_ratio, iterations=1, states=True).states
