"""`sprung bench exchange`: exports, run by the programs that they are for, against our own free run.

Vehicles: the bundled one, linear and with a law drawn from the seed in one of its elements.  The FMU runs through FMPy
(compiled with the machine's cc), the .mat is read by SciPy and run by python-control.  Figures are the largest
difference of any output over the largest value of that output; targets 1e-6 without and 1e-3 with laws.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.interpolate import CubicSpline

from sprung.model.address import LawValue
from sprung.model.exchange.fmu import write_fmu
from sprung.model.exchange.statespace import state_space, write_mat
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system
from sprung.service.errors import UserError

RATE = 500.0  # Hz, at which cubics between samples are the ride itself
PARTS = 64  # steps of co-simulation per sample, and of the linear run
LIMITS = {"linear": 1e-6, "laws": 1e-3}


def run(seed: int = 20261, seconds: float = 1.0) -> Iterator[dict[str, Any]]:
    """seconds: length of the ride, which begins at rest."""
    rng = np.random.default_rng(seed)
    bundled = load_system()
    vehicle = System(bundled.file.model_copy(update={"sample_rate": RATE}))
    values, fine = _ride(vehicle, seconds, rng)
    yield _figure("control", "linear", _by_control(vehicle, fine), simulate_ride(vehicle, values).sensors, vehicle)
    for name, system in (("linear", vehicle), *_with_laws(vehicle, rng)):
        ours = simulate_ride(system, values).sensors
        yield _figure("fmpy", name, _by_fmpy(system, values), ours, system)


def _figure(tool: str, law: str, theirs: FloatArray, ours: FloatArray, system: System) -> dict[str, Any]:
    error = np.abs(theirs - ours[: len(theirs)]).max(axis=0) / np.abs(ours).max(axis=0)
    limit = LIMITS["linear" if law == "linear" else "laws"]
    worst = int(error.argmax())
    return {
        "by": tool,
        "laws": law,
        "error": float(f"{error.max():.2g}"),
        "at": system.sensors[worst],
        "limit": limit,
        "within": bool(error.max() < limit),
    }


def _ride(system: System, seconds: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Supports from rest, smoothly, in a few tones: channels at the samples (T, U), and on the fine grid."""
    fine = np.arange(round(seconds * system.sample_rate) * PARTS + 1) / (PARTS * system.sample_rate)
    columns = []
    for _ in system.file.inputs:
        w, size = rng.uniform(3, 30, 4), rng.uniform(2e-4, 2e-3, 4)
        columns.append((size * (1 - np.cos(w * fine[:, None]))).sum(axis=1))
        columns.append((size * w * np.sin(w * fine[:, None])).sum(axis=1))
    whole = np.stack(columns, axis=1)
    return whole[::PARTS], whole


def _with_laws(system: System, rng: np.random.Generator) -> list[tuple[str, System]]:
    """The vehicle with one law each, of a size that matters beside the spring's and damper's forces."""
    k, c = 1.0 + 0.3 * rng.random(2)
    settings: dict[str, dict[str, float | LawValue | str]] = {
        "coulomb_friction": {"force": 300 * k, "smoothing": 0.02 * c},
        "bump_stop": {"gap": 0.002 * k, "stiffness": 3e5 * c},
        "bouc_wen": {"alpha": 8e4 * k, "beta": 400 * c, "n": 1.0},
        "series_stiffness": {"ks": 1e6 * k},
    }
    found = []
    for effect, setting in settings.items():
        name = str(rng.choice(system.elements[8:]))
        element = system.file.elements[name].model_copy(update={"laws": ({effect: setting},)})
        file = system.file.model_copy(update={"elements": {**system.file.elements, name: element}})
        found.append((effect, System(file)))
    return found


def _by_control(system: System, fine: FloatArray) -> FloatArray:
    """The matrices of a .mat through SciPy and python-control, at the samples."""
    control = _module("control")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vehicle.mat"
        write_mat(path, state_space(system))
        read = scipy.io.loadmat(path)
    plant = control.ss(read["A"], read["B"], read["C"], read["D"])
    time = np.arange(len(fine)) / (PARTS * system.sample_rate)
    answer = control.forced_response(plant, time, fine.T).outputs
    return np.asarray(answer)[:, ::PARTS].T


def _by_fmpy(system: System, values: FloatArray) -> FloatArray:
    """The FMU in co-simulation, at the samples."""
    if shutil.which("cc") is None:
        raise UserError("bench exchange compiles FMUs: no cc on this machine")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vehicle.fmu"
        write_fmu(path, system)
        return cosimulated(path, system, values)


class LoadedFmu:
    """An FMU through FMPy's bindings, set up and at rest."""

    def __init__(self, path: Path, kind: str, values: Mapping[str, float] | None = None) -> None:
        """kind: "coSimulation" or "modelExchange"."""
        fmpy, fmi2 = _module("fmpy"), _module("fmpy.fmi2")
        description = fmpy.read_model_description(str(path))
        loaded = fmi2.FMU2Slave if kind == "coSimulation" else fmi2.FMU2Model
        self.fmu = loaded(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), unzipdir=str(path.parent / "unzipped")),
            modelIdentifier=getattr(description, kind).modelIdentifier,
            instanceName="a",
        )
        self.at = {v.name: v.valueReference for v in description.modelVariables}
        self.states = len(description.derivatives)
        self.fmu.instantiate()
        self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        for name, value in (values or {}).items():
            self.fmu.setReal([self.at[name]], [value])
        self.fmu.exitInitializationMode()

    def set(self, names: Sequence[str], u: FloatArray) -> None:
        """Set inputs by name."""
        self.fmu.setReal([self.at[name] for name in names], u.tolist())

    def shown(self, names: Sequence[str]) -> list[float]:
        """Outputs by name."""
        return [float(value) for value in self.fmu.getReal([self.at[name] for name in names])]


def cosimulated(
    path: Path,
    system: System,
    values: FloatArray,
    names: Sequence[str] = (),
    set_to: Mapping[str, float] | None = None,
) -> FloatArray:
    """Outputs (all sensors, or `names`) at the samples but the last of an FMU under the drives `values` (T, U).

    Inputs are continued with the slopes of the cubics through them, in `PARTS` steps per sample.
    """
    loaded, shown = LoadedFmu(path, "coSimulation", set_to), []
    drives = list(state_space(system).inputs)
    wanted = names or system.sensors
    step = 1 / (PARTS * system.sample_rate)
    fine = CubicSpline(np.arange(len(values)), values)(np.arange((len(values) - 1) * PARTS + 1) / PARTS)
    references, orders = [loaded.at[name] for name in drives], [1] * len(drives)
    for k, (now, then) in enumerate(pairwise(fine)):
        loaded.set(drives, now)
        if k % PARTS == 0:
            shown.append(loaded.shown(wanted))
        loaded.fmu.setRealInputDerivatives(references, orders, ((then - now) / step).tolist())
        loaded.fmu.doStep(currentCommunicationPoint=k * step, communicationStepSize=step)
    return np.array(shown)


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"bench exchange needs {name.partition('.')[0]}: pip install 'sprung[dev]'") from None
