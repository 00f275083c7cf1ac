"""A baseline system from an FMU for model exchange (FMI 2.0), linearised by its directional derivatives through FMPy.

    A = d der(x) / d x,   B = d der(x) / d u,   C = d y / d x,   D = d y / d u    where the FMU starts

States are put in order, displacements and then their velocities, by what their derivatives say; inputs in pairs by
their names.  From there on it is a model like any other in matrices.  The FMU's own binary runs on this machine.
"""

from __future__ import annotations

import importlib
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.exchange.statespace import ExchangeError
from sprung.model.signals import FloatArray

_SAME = 1e-6  # of the largest entry of A: directional derivatives may be differences
_VELOCITY = re.compile(r"^der\((?P<of>.+)\)$|^(?P<stem>.+?)[._ ](?:velocity|rate|v|dot)$", re.IGNORECASE)
_DISPLACEMENT = re.compile(r"^(?P<stem>.+?)[._ ](?:displacement|position|z|s)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class LinearFmu:
    """A linear model with names: states are displacements, then their velocities, inputs in pairs of the same."""

    A: FloatArray  # (2n, 2n)
    B: FloatArray  # (2n, 2 s)
    C: FloatArray  # (p, 2n)
    states: tuple[str, ...]  # of the displacements, n
    supports: tuple[str, ...]  # s
    outputs: tuple[str, ...]  # p


def read_fmu(path: Path) -> LinearFmu:
    """Linearise an FMU.  Errors: `ExchangeError`, one line."""
    fmpy, fmi2 = _fmpy()
    description = _linearisable(path, fmpy)
    derivatives, states, inputs, outputs = _variables(path, description)
    rows = [v.valueReference for v in (*derivatives, *outputs)]
    columns = [v.valueReference for v in (*states, *inputs)]
    found = _derivatives(path, fmpy, fmi2, description, rows, columns)
    N = len(states)
    return _ordered(
        path,
        (found[:N, :N], found[:N, N:], found[N:, :N]),
        [v.name for v in states],
        [v.name for v in inputs],
        tuple(v.name for v in outputs),
    )


def _linearisable(path: Path, fmpy: Any) -> Any:
    """The description of an FMU for model exchange with directional derivatives."""
    try:
        description = fmpy.read_model_description(str(path))
    except Exception as error:  # whatever a broken archive or description raises there
        raise ExchangeError(f"{path}: no FMU that can be read: {' '.join(str(error).split())[:150]}") from error
    exchange = description.modelExchange
    if not str(description.fmiVersion).startswith("2.") or exchange is None:
        raise ExchangeError(f"{path}: an FMU of FMI 2.0 for model exchange is needed")
    if not exchange.providesDirectionalDerivative:
        raise ExchangeError(f"{path}: the FMU gives no directional derivatives; export it with them")
    return description


def _variables(path: Path, description: Any) -> tuple[list[Any], list[Any], list[Any], list[Any]]:
    """Derivatives of the states, states, inputs and outputs."""
    derivatives = [unknown.variable for unknown in description.derivatives]
    states = [variable.derivative for variable in derivatives]
    inputs = [v for v in description.modelVariables if v.causality == "input" and v.type == "Real"]
    outputs = [v for v in description.modelVariables if v.causality == "output" and v.type == "Real"]
    if not states or not inputs or not outputs:
        raise ExchangeError(
            f"{path}: states, inputs and outputs are needed; it has {len(states)}, {len(inputs)}, {len(outputs)}"
        )
    return derivatives, states, inputs, outputs


def _fmpy() -> tuple[Any, Any]:
    try:
        return importlib.import_module("fmpy"), importlib.import_module("fmpy.fmi2")
    except ImportError:
        raise ExchangeError("FMUs are read through FMPy: pip install 'sprung[fmu]'") from None


def _derivatives(
    path: Path, fmpy: Any, fmi2: Any, description: Any, unknowns: Sequence[int], knowns: Sequence[int]
) -> FloatArray:
    """Directional derivatives (unknowns, knowns) where the FMU starts."""
    folder = tempfile.mkdtemp(prefix="sprung-fmu-")
    try:
        unit = fmi2.FMU2Model(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), unzipdir=folder),
            modelIdentifier=description.modelExchange.modelIdentifier,
            instanceName="baseline",
        )
        unit.instantiate()
        unit.setupExperiment()
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        columns = [unit.getDirectionalDerivative(list(unknowns), [known], [1.0]) for known in knowns]
        unit.terminate()
        unit.freeInstance()
    except Exception as error:  # FMPy raises bare ones, and so does a binary of another machine
        raise ExchangeError(f"{path}: the FMU does not run here: {' '.join(str(error).split())[:150]}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    found = np.array(columns, dtype=np.float64).T
    if not np.isfinite(found).all():
        raise ExchangeError(f"{path}: its derivatives are not finite where it starts")
    return found


def _ordered(
    path: Path,
    matrices: tuple[FloatArray, FloatArray, FloatArray],
    states: Sequence[str],
    inputs: Sequence[str],
    outputs: tuple[str, ...],
) -> LinearFmu:
    """States as displacements, then velocities; inputs as pairs of the same."""
    A, B, C = matrices
    velocity = {}
    for i, row in enumerate(A):
        at = np.flatnonzero(np.abs(row) > _SAME)
        if len(at) == 1 and abs(row[at[0]] - 1) < _SAME and np.abs(B[i]).max(initial=0.0) < _SAME:
            velocity[i] = int(at[0])
    velocity = {i: j for i, j in velocity.items() if j not in velocity}
    order = [*velocity, *velocity.values()]
    if sorted(order) != list(range(len(A))):
        odd = next(i for i in range(len(A)) if i not in order)
        raise ExchangeError(f"{path}: state {states[odd]} is neither a displacement nor the velocity of one")
    supports, columns = _pairs(path, inputs)
    n = len(velocity)
    A, C = A[np.ix_(order, order)], C[:, order]
    A[:n] = np.eye(n, 2 * n, n)
    paired = np.column_stack([B[:, i] if i >= 0 else np.zeros(len(B)) for i in columns])[order]
    paired[:n] = 0.0
    return LinearFmu(A, paired, C, tuple(states[i] for i in velocity), supports, outputs)


def _pairs(path: Path, inputs: Sequence[str]) -> tuple[tuple[str, ...], list[int]]:
    """Supports, and for each the columns of its displacement and its velocity (-1: it has none)."""
    stems: dict[str, list[int]] = {}
    for i, name in enumerate(inputs):
        speed, place = _VELOCITY.match(name), _DISPLACEMENT.match(name)
        stem = (speed["of"] or speed["stem"]) if speed else place["stem"] if place else name
        inner = _DISPLACEMENT.match(stem)
        pair = stems.setdefault(inner["stem"] if speed and speed["of"] and inner else stem, [-1, -1])
        if pair[bool(speed)] >= 0:
            raise ExchangeError(f"{path}: inputs {inputs[pair[bool(speed)]]} and {name} are the same motion by name")
        pair[bool(speed)] = i
    for stem, (place_at, speed_at) in stems.items():
        if place_at < 0:
            raise ExchangeError(f"{path}: input {inputs[speed_at]} is a velocity without {stem}.displacement")
    return tuple(stems), [i for pair in stems.values() for i in pair]
