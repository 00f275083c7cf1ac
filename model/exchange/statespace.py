"""The linear system as matrices with names: x' = A x + B u, y = C x + D u, and their derivatives by the parameters.

Laws along the elements are left out: no matrix holds them; the FMU and Modelica exports do (docs/exchange.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from sprung.model.laws.in_place import Follower
from sprung.model.mechanics import Mechanics
from sprung.model.parameters import Parameter
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import with_values
from sprung.model.system import System


class ExchangeError(ValueError):
    """A system that cannot be written in, or read from, a format; one line."""


@dataclass(frozen=True, slots=True)
class StateSpace:
    """Matrices of one system; N states, U drives, S sensors, P parameters."""

    A: FloatArray  # (N, N)
    B: FloatArray  # (N, U)
    C: FloatArray  # (S, N)
    D: FloatArray  # (S, U)
    dA: FloatArray  # by the parameters, (P, N, N)
    dB: FloatArray  # (P, N, U)
    dC: FloatArray  # (P, S, N)
    dD: FloatArray  # (P, S, U)
    states: tuple[str, ...]  # "car.z", ..., "car.z'", ...
    inputs: tuple[str, ...]  # "wheel_11l.displacement", "wheel_11l.velocity", ...
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    values: FloatArray  # of the parameters, (P,)
    sample_rate: float  # Hz, of the recordings; the matrices are of continuous time
    mass: FloatArray  # mass or inertia of each degree of freedom, the scale that A and B do not determine, (N / 2,)


def state_space(system: System, values: Mapping[str, float] | None = None) -> StateSpace:
    """The system at its nominal values, or others by name, laws of bodies and of the structure included."""
    system = system.whole_system
    mechanics = with_values(system, values or {})
    A, B, C, D = mechanics.matrices()
    slopes = [_derivative(system, mechanics, p) for p in system.parameters]
    dA, dB, dC, dD = (
        np.array([slope[i] for slope in slopes]).reshape(-1, *matrix.shape) for i, matrix in enumerate((A, B, C, D))
    )
    return StateSpace(
        A=A,
        B=B,
        C=C,
        D=D,
        dA=dA,
        dB=dB,
        dC=dC,
        dD=dD,
        states=(*mechanics.dofs, *(f"{dof}'" for dof in mechanics.dofs)),
        inputs=_drive_names(system),
        outputs=system.sensors,
        parameters=tuple(p.name for p in system.parameters),
        values=np.array([_value(system, mechanics, p) for p in system.parameters]),
        sample_rate=system.sample_rate,
        mass=mechanics.mass,
    )


def _derivative(system: System, mechanics: Mechanics, parameter: Parameter) -> tuple[FloatArray, ...]:
    """dA, dB, dC, dD by one parameter; the matrices are linear in stiffness and damping, and in 1 / mass."""
    follower, value = _follower(system, parameter), _value(system, mechanics, parameter)
    k, c = (np.zeros_like(mechanics.stiffness) for _ in range(2))
    if follower is not None and follower.element >= 0:
        at = follower.element
        k[at] = follower.stiffness * mechanics.stiffness[at] / value
        c[at] = follower.damping * mechanics.damping[at] / value
    elif follower is not None or parameter.quantity == "mass":  # mass and inertias of a body scale together
        body = system.bodies.index(parameter.element) if follower is None else follower.body
        return _scaled_rows(mechanics, np.where(mechanics.body_of_dof == body, -1 / value, 0.0))
    else:
        (k if parameter.quantity == "stiffness" else c)[system.elements.index(parameter.element)] = 1.0
    none = np.zeros_like(k)
    unit, zero = mechanics.matrices(k, c), mechanics.matrices(none, none)
    return tuple(a - b for a, b in zip(unit, zero, strict=True))


def _scaled_rows(mechanics: Mechanics, rows: FloatArray) -> tuple[FloatArray, ...]:
    """Changes when the acceleration of every degree of freedom grows by its entry of `rows`."""
    A, B, *_ = mechanics.matrices()
    n = mechanics.n
    dA, dB = np.zeros_like(A), np.zeros_like(B)
    dA[n:], dB[n:] = rows[:, None] * A[n:], rows[:, None] * B[n:]
    accelerates = mechanics.sensor_kind[:, None] == 0
    dC = np.where(accelerates, mechanics.S @ dA[n:], 0.0)
    dD = np.where(accelerates, mechanics.S @ dB[n:], 0.0)
    return dA, dB, dC, dD


def _value(system: System, mechanics: Mechanics, parameter: Parameter) -> float:
    if _follower(system, parameter) is not None:
        return parameter.nominal
    part, quantity = parameter.element, parameter.quantity
    if quantity == "mass":
        at = np.flatnonzero(mechanics.body_of_dof == system.bodies.index(part))[0]
        return float(system.file.bodies[part].mass.value * mechanics.mass[at] / system.mechanics.mass[at])
    values: FloatArray = getattr(mechanics, quantity)
    return float(values[system.elements.index(part)])


def _follower(system: System, parameter: Parameter) -> Follower | None:
    return next((one for one in system.followers if one.parameter.name == parameter.name), None)


def _drive_names(system: System) -> tuple[str, ...]:
    names: list[str] = []
    for name, source in system.file.inputs.items():
        names += [f"{name}.force"] if source.kind == "force" else [f"{name}.displacement", f"{name}.velocity"]
    return tuple(names)


def write_npz(path: Path, space: StateSpace) -> None:
    """NumPy archive; names are arrays of text."""
    np.savez(path, **_arrays(space))


def write_mat(path: Path, space: StateSpace) -> None:
    """MATLAB file (v5) with one variable per matrix; names are cell arrays of text."""
    arrays = _arrays(space)
    for name in ("states", "inputs", "outputs", "parameters"):
        arrays[name] = np.array(list(getattr(space, name)), dtype=object)
    scipy.io.savemat(path, arrays, do_compression=True, oned_as="column")


def _arrays(space: StateSpace) -> dict[str, Any]:
    names = ("A", "B", "C", "D", "dA", "dB", "dC", "dD", "values", "mass")
    found: dict[str, Any] = {name: getattr(space, name) for name in names}
    found |= {name: np.array(getattr(space, name)) for name in ("states", "inputs", "outputs", "parameters")}
    found["sample_rate"] = np.array(space.sample_rate)
    return found
