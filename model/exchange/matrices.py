"""A baseline system from matrices: M, C, K with sensor rows or A, B, C, D of a .mat file, or a linearised FMU.

Every coordinate becomes a body that heaves, every coupling a spring and damper between two bodies or to a moving
support, so that its values can be identified and laws sought in it.  That is possible where the matrices are those of
such a network: M diagonal, K and C symmetric with no positive coupling.  Anything else is refused in one line; what
was read is assembled again and must give the same matrices.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse
import yaml

from sprung.model.exchange.from_fmu import read_fmu
from sprung.model.exchange.statespace import ExchangeError
from sprung.model.sensor_kinds import KINDS, USUAL_NOISE, Kind
from sprung.model.signals import FloatArray
from sprung.model.system import System, parse_system

_KEYS = ("M", "C", "K", "Kb", "Cb", "S", "A", "B", "D", "mass", "sample_rate")
FASTEST = 1e6  # Hz
_SAME = 1e-8  # relative to the largest entry of a matrix
_DIFFERENCES = 1e-6  # the same of derivatives that an FMU may take by differences


@dataclass(frozen=True, slots=True)
class SpringNetwork:
    """Coordinates, what couples them to each other and to supports, and sensors."""

    mass: FloatArray  # kg, (n,)
    K: FloatArray  # N/m, (n, n)
    C: FloatArray  # N s/m, (n, n)
    Kb: FloatArray  # by the displacements of the supports, (n, s)
    Cb: FloatArray  # by their velocities, (n, s)
    sensors: tuple[
        tuple[Kind, int, int], ...
    ]  # kind, coordinate, the coordinate that a deflection is counted from or -1


def read_matrices(path: Path, name: str | None = None, rate: float | None = None) -> str:
    """The text of a system file from a .mat file.

    M, C, K: M (n, n) or its diagonal; Kb, Cb (n, s): forces by the supports' motions, left out: what the rows of K and
    C leave over leads to one support; S (p, n): sensor rows, +1 for the acceleration of a coordinate, +1 and -1 for the
    deflection between two; left out: every acceleration.
    A, B, C, D: states are displacements, then velocities; columns of B are displacement and velocity of one support
    after the other, as `--export` writes them; rows of C are displacements, velocities, accelerations or deflections.
    `mass` (n,) says the scale, or its first entry; left out: the first coordinate weighs 1 kg, which no sensor of
    motion can identify.
    states, inputs, outputs: names, where they are given, for bodies, supports and sensors.
    rate: Hz, of the recordings; else `sample_rate` of the file.
    Errors: `ExchangeError`, OSError.
    """
    if not path.is_file():
        raise ExchangeError(f"{path}: {'is a folder' if path.is_dir() else 'there is no such file'}")
    if path.suffix.lower() == ".fmu":
        return _from_fmu(path, name, rate)
    try:
        data = scipy.io.loadmat(path)
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read: damaged, cut short or not permitted ({error})") from error
    except (ValueError, TypeError, NotImplementedError, scipy.io.matlab.MatReadError) as error:
        raise ExchangeError(f"{path}: no .mat file of version 4 to 7: {' '.join(str(error).split())[:150]}") from error
    given = {key: _matrix(path, key, data[key]) for key in _KEYS if key in data}
    sampled = rate if rate is not None else _number(given, "sample_rate")
    if sampled is None:
        raise ExchangeError(f"{path}: no sample_rate; give the rate of the recordings in Hz by --rate")
    _check_rate(path, sampled)
    found = _from_state_space(path, given) if "A" in given else _from_mck(path, given)
    text = _text(found, name or path.stem, sampled, _given_names(path, data, found))
    _same_again(path, found, parse_system(text, str(path)))
    return text


def _given_names(path: Path, data: Mapping[str, Any], found: SpringNetwork) -> _Names:
    """`states`, `inputs` and `outputs` of a .mat file, as written by `--export`; empty if absent."""
    n, supports = found.Kb.shape
    states, inputs, outputs = (_texts(data.get(name)) for name in ("states", "inputs", "outputs"))
    if inputs is not None and len(inputs) == 2 * supports:  # displacement and velocity of one support after the other
        inputs = inputs[::2]
    wanted = (
        ("states", states, (n, 2 * n)),
        ("inputs", inputs, (supports,)),
        ("outputs", outputs, (len(found.sensors),)),
    )
    for name, given, counts in wanted:
        if given is not None and len(given) not in counts:
            raise ExchangeError(f"{path}: {name}: {len(given)} names for {counts[0]}")
    return _Names((states or ())[:n], inputs or (), outputs or ())


def _texts(value: Any) -> tuple[str, ...] | None:
    """Names of a cell array or of rows of characters; None: there are none."""
    try:
        return None if value is None else tuple(str(np.squeeze(one)).strip() for one in np.ravel(value))
    except ValueError:
        return None


def _from_fmu(path: Path, name: str | None, rate: float | None) -> str:
    """The text of a system file from an FMU's A, B, C."""
    if rate is None:
        raise ExchangeError(f"{path}: give the rate of the recordings in Hz by --rate")
    _check_rate(path, rate)
    linear = read_fmu(path)
    network = _from_state_space(path, {"A": linear.A, "B": linear.B, "C": linear.C}, _DIFFERENCES)
    names = _Names(linear.states, linear.supports, linear.outputs)
    text = _text(network, name or path.stem, rate, names)
    _same_again(path, network, parse_system(text, str(path)), _DIFFERENCES)
    return text


def _check_rate(path: Path, rate: float) -> None:
    if not 0 < rate <= FASTEST:
        raise ExchangeError(f"{path}: sample_rate {rate:g} Hz: it must be above 0 and at most {FASTEST:g}")


def _matrix(path: Path, name: str, value: Any) -> FloatArray:
    if np.iscomplexobj(value.data if scipy.sparse.issparse(value) else value):
        raise ExchangeError(f"{path}: {name}: its numbers are complex; real ones are needed")
    try:
        found = np.atleast_2d(np.asarray(value.toarray() if scipy.sparse.issparse(value) else value, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise ExchangeError(f"{path}: {name}: is no matrix of numbers") from error
    if found.ndim != 2 or not found.size:
        raise ExchangeError(f"{path}: {name}: is no matrix, or an empty one")
    if not np.isfinite(found).all():
        raise ExchangeError(f"{path}: {name}: numbers that are not finite")
    return found


def _number(given: Mapping[str, FloatArray], name: str) -> float | None:
    return float(given[name].ravel()[0]) if name in given and given[name].size else None


def _from_mck(path: Path, given: Mapping[str, FloatArray]) -> SpringNetwork:
    missing = [name for name in ("M", "K") if name not in given]
    if missing:
        raise ExchangeError(f"{path}: neither A, B, C, D nor M, C, K are in it: {missing[0]} is missing")
    K = given["K"]
    n = len(K)
    C = given.get("C", np.zeros((n, n)))
    M = given["M"]
    mass = M.ravel() if M.size == n and n > 1 else np.diag(M)
    if K.shape != (n, n) or C.shape != (n, n) or mass.shape != (n,):
        raise ExchangeError(f"{path}: M {M.shape}, C {C.shape} and K {K.shape} are not of the same size")
    if M.shape == (n, n) and np.abs(M - np.diag(mass)).max() > _SAME * np.abs(M).max():
        raise ExchangeError(f"{path}: M is not diagonal: its coordinates are not those of single bodies")
    if "Kb" in given or "Cb" in given:
        Kb = given["Kb"] if "Kb" in given else np.zeros_like(given["Cb"])
        Cb = given["Cb"] if "Cb" in given else np.zeros_like(given["Kb"])
    else:
        Kb, Cb = K.sum(axis=1, keepdims=True), C.sum(axis=1, keepdims=True)
    if Kb.shape != Cb.shape or len(Kb) != n:
        raise ExchangeError(f"{path}: Kb {Kb.shape} and Cb {Cb.shape}: a row for each of {n} coordinates is needed")
    rows = given.get("S", np.eye(n))
    if rows.shape[1] != n:
        raise ExchangeError(f"{path}: S {rows.shape}: a column for each of {n} coordinates is needed")
    sensors = tuple(_sensor_of_row(path, i, row) for i, row in enumerate(rows))
    return _checked(path, SpringNetwork(mass, K, C, Kb, Cb, sensors))


def _sensor_of_row(path: Path, number: int, row: FloatArray) -> tuple[Kind, int, int]:
    at = np.flatnonzero(row)
    if len(at) == 1 and row[at[0]] == 1:
        return "acceleration", int(at[0]), -1
    if len(at) == 2 and sorted(row[at]) == [-1, 1]:
        return "deflection", int(at[row[at] == 1][0]), int(at[row[at] == -1][0])
    raise ExchangeError(f"{path}: S: row {number + 1} is neither one coordinate (1) nor a difference of two (1, -1)")


def _from_state_space(path: Path, given: Mapping[str, FloatArray], same: float = _SAME) -> SpringNetwork:
    """same: how far entries that should be equal may be apart, relative to the largest of their matrix."""
    missing = [name for name in ("B", "C") if name not in given]
    if missing:
        raise ExchangeError(f"{path}: A without {missing[0]}")
    A, B, rows = given["A"], given["B"], given["C"]
    n = len(A) // 2
    if A.shape != (2 * n, 2 * n) or n == 0 or len(B) != 2 * n or rows.shape[1] != 2 * n or B.shape[1] % 2:
        raise ExchangeError(
            f"{path}: A {A.shape}, B {B.shape}, C {rows.shape} do not go together; B needs two columns a support"
        )
    if np.abs(A[:n] - np.eye(n, 2 * n, n)).max() > _SAME or np.abs(B[:n]).max() > _SAME * np.abs(B).max():
        raise ExchangeError(f"{path}: A: states are not displacements, then their velocities")
    X, Y = (_without_dust(part, same) for part in (-A[n:, :n], -A[n:, n:]))
    Kb, Cb = (_without_dust(B[n:, i::2], same) for i in (0, 1))
    mass = _masses(path, X, given.get("mass"))
    scale = mass[:, None]
    sensors = tuple(_sensor_of_output(path, i, row, A, same) for i, row in enumerate(rows))
    if "D" in given:
        _check_feedthrough(path, given["D"], sensors, B, same)
    return _checked(path, SpringNetwork(mass, scale * X, scale * Y, scale * Kb, scale * Cb, sensors), same)


def _without_dust(matrix: FloatArray, same: float) -> FloatArray:
    """Entries that are nothing but rounding are none."""
    return np.where(np.abs(matrix) > same * np.abs(matrix).max(initial=0.0), matrix, 0.0)


def _masses(path: Path, X: FloatArray, given: FloatArray | None) -> FloatArray:
    """Masses that make M X symmetric: known up to one factor for coordinates that hang together."""
    n = len(X)
    if given is not None and given.size == n:
        return given.ravel()
    if given is not None and given.size > 1:
        raise ExchangeError(f"{path}: mass: {given.size} numbers for {n} coordinates; one or all of them are needed")
    mass = np.full(n, np.nan)
    mass[0] = 1.0 if given is None or not given.size else given.ravel()[0]
    waiting = [0]
    while waiting:
        i = waiting.pop()
        for j in np.flatnonzero(np.isnan(mass)):
            if X[i, j] and X[j, i]:
                mass[j] = mass[i] * X[i, j] / X[j, i]
                waiting.append(int(j))
    if np.isnan(mass).any():
        apart, fmu = int(np.isnan(mass).argmax()) + 1, path.suffix.lower() == ".fmu"
        advice = "" if fmu else "; give the masses as `mass`"
        raise ExchangeError(
            f"{path}: A: coordinate {apart} hangs together with no other (rotations do not): its mass is open{advice}"
        )
    return mass


def _sensor_of_output(path: Path, number: int, row: FloatArray, A: FloatArray, same: float) -> tuple[Kind, int, int]:
    n = len(A) // 2
    for i in range(n):
        if np.allclose(row, A[n + i], rtol=1e-9, atol=same * np.abs(A[n + i]).max()):
            return "acceleration", i, -1
    row = _without_dust(row, same)
    row = np.where(np.abs(np.abs(row) - 1) < same, np.sign(row), row)
    at = np.flatnonzero(row)
    if len(at) == 1 and row[at[0]] == 1:
        return ("displacement", int(at[0]), -1) if at[0] < n else ("velocity", int(at[0] - n), -1)
    if len(at) == 2 and at.max() < n and sorted(row[at]) == [-1, 1]:
        return "deflection", int(at[row[at] == 1][0]), int(at[row[at] == -1][0])
    raise ExchangeError(
        f"{path}: C: row {number + 1} is no displacement, velocity, acceleration or deflection of single coordinates; "
        "bodies that roll or pitch cannot be imported: describe them in a system file"
    )


def _check_feedthrough(
    path: Path, D: FloatArray, sensors: Sequence[tuple[Kind, int, int]], B: FloatArray, same: float
) -> None:
    """D says nothing new: what supports do at once to an acceleration is in B, and to no other output is anything."""
    n = len(B) // 2
    wanted = np.array([B[n + i] if kind == "acceleration" else np.zeros(B.shape[1]) for kind, i, _ in sensors])
    if D.shape != wanted.shape:
        raise ExchangeError(f"{path}: D {D.shape}: a row for each row of C and a column for each of B are needed")
    wrong = np.abs(D - wanted).max(axis=1) > max(same, 1e-9) * (np.abs(wanted).max() or 1.0)
    if wrong.any():
        row = int(wrong.argmax())
        raise ExchangeError(
            f"{path}: D: row {row + 1} is not what A, B and C say of this {sensors[row][0]}: the rows of an "
            "acceleration are those of B, all others 0"
        )


def _checked(path: Path, found: SpringNetwork, same: float = _SAME) -> SpringNetwork:
    if not any(np.abs(matrix).max(initial=0.0) > 0 for matrix in (found.K, found.C)):
        raise ExchangeError(f"{path}: K and C are 0: nothing couples the coordinates")
    if not (found.mass > 0).all():
        raise ExchangeError(f"{path}: a mass is not greater than 0")
    for name, matrix in (("K", found.K), ("C", found.C)):
        size = np.abs(matrix).max() or 1.0
        if np.abs(matrix - matrix.T).max() > same * size:
            raise ExchangeError(f"{path}: {name} is not symmetric: no network of springs and dampers has it")
        if (matrix - np.diag(np.diag(matrix))).max(initial=0.0) > same * size:
            i, j = np.argwhere(matrix - np.diag(np.diag(matrix)) > same * size)[0]
            raise ExchangeError(f"{path}: {name}({i + 1}, {j + 1}) is positive: no spring between two bodies pushes so")
    for name, matrix in (("Kb", found.Kb), ("Cb", found.Cb)):
        if matrix.min(initial=0.0) < -same * (np.abs(matrix).max(initial=0.0) or 1.0):
            raise ExchangeError(f"{path}: {name}: a support is coupled by a negative value")
    for name, inner, outer in (("K", found.K, found.Kb), ("C", found.C, found.Cb)):
        over = inner.sum(axis=1) - outer.sum(axis=1)
        if np.abs(over).max() > same * (np.abs(inner).max() or 1.0):
            i = int(np.abs(over).argmax())
            raise ExchangeError(
                f"{path}: {name}: row {i + 1} leaves {over[i]:.4g} that no support takes: springs to a fixed ground "
                "need a support that stands still among the columns of Kb"
            )
    return found


@dataclass(frozen=True, slots=True)
class _Names:
    """What a model calls its displacements, supports and outputs; empty where it has no names for them."""

    states: tuple[str, ...] = ()
    supports: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()


def _plain(names: Sequence[str], tails: tuple[str, ...] = ()) -> list[str]:
    """Names as a system file may have them, all different."""
    found: list[str] = []
    for name in names:
        short = next((name.removesuffix(tail) for tail in tails if name.endswith(tail)), name)
        plain = re.sub(r"[^A-Za-z0-9_]+", "_", short).strip("_")
        plain = plain if plain[:1].isalpha() else f"n{plain}"
        found.append(plain if plain not in found else f"{plain}_{len(found) + 1}")
    return found


def _text(found: SpringNetwork, name: str, rate: float, names: _Names) -> str:
    n, supports = len(found.mass), found.Kb.shape[1]
    body = _plain(names.states, (".z", "_z", ".s")) or [f"body{i + 1}" for i in range(n)]
    support = _plain(names.supports, (".displacement",)) or [f"support{i + 1}" for i in range(supports)]
    elements: dict[str, Any] = {}
    for i in range(n):
        for j in range(i + 1, n):
            _add(elements, body[i], body[j], -found.K[i, j], -found.C[i, j])
        for j in range(supports):
            _add(elements, body[i], support[j], found.Kb[i, j], found.Cb[i, j])
    sensors: dict[str, dict[str, Any]] = {}
    for kind, i, j in found.sensors:
        key, entry = _sensor(kind, i, j, body, elements)
        count = sum(one == key or one.startswith(f"{key}_") for one in sensors)  # two sensors may measure the same
        key = f"{key}_{count + 1}" if count else key
        sensors[key] = entry | {"csv": key}
    if names.outputs:
        called = zip(_plain(names.outputs), names.outputs, found.sensors, strict=True)
        sensors = {key: _sensor(*sensor, body, elements)[1] | {"csv": column} for key, column, sensor in called}
    inputs = {
        one: {
            "kind": "displacement",
            "displacement": {"csv": f"{one}.displacement", "noise": USUAL_NOISE["m"]},
            "velocity": {"csv": f"{one}.velocity", "noise": USUAL_NOISE["m/s"]},
        }
        for one in support
    }
    file = {
        "name": name,
        "sample_rate": rate,
        "window": max(20, round(rate)),
        "bodies": {one: {"mass": float(mass)} for one, mass in zip(body, found.mass, strict=True)},
        "inputs": inputs,
        "elements": elements,
        "sensors": sensors,
    }
    head = "# From matrices: set the noises of sensors and inputs to those of your instruments, and their columns.\n"
    return head + yaml.safe_dump(file, sort_keys=False, width=110)


def _add(elements: dict[str, Any], upper: str, lower: str, k: float, c: float) -> None:
    if k or c:
        values = {key: float(value) for key, value in (("stiffness", k), ("damping", c)) if value}
        elements[f"{upper}_{lower}"] = {"upper": upper, "lower": lower} | values


def _sensor(kind: Kind, i: int, j: int, body: list[str], elements: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    noise = KINDS[kind].noise
    if kind != "deflection":
        name = f"{body[i]}_{kind}"
        return name, {"kind": kind, "body": body[i], "csv": name, "noise": noise}
    first, second = sorted((i, j))
    element = f"{body[first]}_{body[second]}"
    if element not in elements:
        raise ExchangeError(f"a deflection is measured between {body[i]} and {body[j]}, which nothing connects")
    name = f"{element}_deflection"
    entry = {"kind": kind, "element": element, "csv": name, "noise": noise}
    return name, entry | ({"sign": -1} if i > j else {})


def _same_again(path: Path, found: SpringNetwork, system: System, same: float = _SAME) -> None:
    n, scale = len(found.mass), found.mass[:, None]
    A, B, *_ = system.mechanics.matrices()
    pairs = (
        (-A[n:, :n] * scale, found.K),
        (-A[n:, n:] * scale, found.C),
        (B[n:, 0::2] * scale, found.Kb),
        (B[n:, 1::2] * scale, found.Cb),
    )
    if any(
        np.abs(ours - theirs).max(initial=0.0) > same * (np.abs(theirs).max(initial=0.0) or 1.0)
        for ours, theirs in pairs
    ):
        raise ExchangeError(
            f"{path}: the system that was made of it has other matrices; this is an error of the program"
        )
