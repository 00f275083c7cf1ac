"""`sprung bench silverbox --data DIR`: missing physics in a measured electronic oscillator.

The record is that of nonlinearbenchmark.org; DIR holds train.csv, test_multisine.csv and arrow.csv with the columns
time, V1 (drive) and V2 (position).  The tool sees the training file and a linear system file.  The model that it
reports is then run freely on the two test files by an integrator of its own (Runge-Kutta of order 4, the drive
interpolated by its band limit).  Two starting values are taken from the first 50 samples of each file, which are not
scored, and one constant force from the training file: the record's drive has an offset of some mV that every model
needs, and that a report may or may not carry as a finding.  Root mean squares in mV.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from sprung.benchmarks.generator.laws import LAWS
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import System, load_system
from sprung.replay.record import Record, load_record
from sprung.service.report.writing import write_report

Array = NDArray[np.float64]
Model = tuple[float, float, float, Callable[[float, float], float]]  # mass, damping, stiffness, force of the laws

SYSTEM = Path(__file__).parent / "systems" / "silverbox.yaml"
UNSCORED = 50  # samples
FINER = 8  # steps per sample
LEVELLED = 3000  # samples of the training file that give the constant force
TARGETS = {"test_multisine.csv": 0.40, "arrow.csv": 0.57}  # mV


def run(data: Path, out: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yields the diagnosis of the training file and the free-run errors on the test files.

    `out` also writes the report there as a page with pictures.
    """
    system = load_system(SYSTEM)
    train = data_file(data, "train.csv")
    record = load_record(train, system.channels, system.sample_rate, time=system.time)
    said = diagnosis_of(system, record, train.name, out)
    yield {
        "verdict": said["verdict"],
        "findings": said["findings"],
        "explained": said["explained"],
        "parameters": {p["name"]: [p["value"], p["std"]] for p in said["augmented"]["parameters"]},
    }
    for name, target in TARGETS.items():
        test = load_record(data_file(data, name), system.channels, system.sample_rate, time=system.time)
        line: dict[str, Any] = {"file": name, "target_mv": target}
        for key in ("baseline", "augmented"):
            findings = said["findings"] if key == "augmented" else []
            model = oscillator(said[key]["parameters"], findings)
            instruments = [*findings, *said["calibration"]] if key == "augmented" else []
            trained, tested = (undone(values, instruments) for values in (record.values[:LEVELLED], test.values))
            offset = constant_force(model, trained, system.sample_rate)
            error = free_run_error(model, tested, system.sample_rate, offset)
            line[f"rmse_{key}_mv"] = 1e3 * error
        yield {**line, "met": line["rmse_augmented_mv"] <= target}


def diagnosis_of(system: System, record: Record, name: str, out: Path | None) -> dict[str, Any]:
    """The report on a record as JSON; `out` also receives its page and pictures."""
    report = diagnose(system, record, options=Options(file=name))
    if out is not None:
        write_report(report, system, out)
    return report.to_dict()


def data_file(data: Path, name: str) -> Path:
    path = data / name
    if not path.is_file():
        raise ValueError(f"{path} is not there; download the record and give its folder with --data")
    return path


def oscillator(parameters: list[dict[str, Any]], findings: list[dict[str, Any]]) -> Model:
    """Mass, damping, stiffness and the force of the reported laws without memory, from a report's JSON."""
    values = {p["name"].rpartition(".")[2]: float(p["value"]) for p in parameters}
    k, c = values["stiffness"], values["damping"]
    laws = [
        (LAWS[f["effect"]].force, [float(p["value"]) for p in f["parameters"]])
        for f in findings
        if f["effect"] in LAWS and not LAWS[f["effect"]].memory
    ]

    def extra(d: float, v: float) -> float:
        return float(sum(force(d, v, p, k, c, 0.0, 0.0) for force, p in laws))

    return values["mass"], c, k, extra


def undone(values: Array, instruments: list[dict[str, Any]]) -> Array:
    """Drive and position, (T, 2), without the gains and offsets that a report has of them."""
    found = values.copy()
    of = {(one["location"], one["effect"]): float(one["parameters"][0]["value"]) for one in instruments}
    for column, channel in enumerate(("drive", "position")):
        found[:, column] -= of.get((channel, "sensor_bias"), 0.0)
        found[:, column] /= of.get((channel, "sensor_gain"), 1.0)
    return found


def free_run(model: Model, drive: Array, rate: float, start: Array) -> Array:
    """Position at every sample, from position and velocity at the first; `drive` has FINER * 2 points a sample."""
    mass, c, k, extra = model
    h = 1 / (rate * FINER)
    x, v = float(start[0]), float(start[1])
    u = drive.tolist()
    out = np.empty(len(u) // (2 * FINER))

    def acceleration(x: float, v: float, force: float) -> float:
        return (force - k * x - c * v - extra(x, v)) / mass

    for sample in range(len(out)):
        out[sample] = x
        for step in range(sample * FINER, (sample + 1) * FINER):
            u0, u1, u2 = u[2 * step], u[2 * step + 1], u[min(2 * step + 2, len(u) - 1)]
            a1 = acceleration(x, v, u0)
            a2 = acceleration(x + h / 2 * v, v + h / 2 * a1, u1)
            v2 = v + h / 2 * a1
            v3 = v + h / 2 * a2
            a3 = acceleration(x + h / 2 * v2, v3, u1)
            v4 = v + h * a3
            a4 = acceleration(x + h * v3, v4, u2)
            x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        if not abs(x) < 1e6:
            out[sample:] = np.nan
            break
    return out


def _free_error(model: Model, values: Array, rate: float, offset: float) -> Array:
    """Simulated less measured position, starting values fitted to the first UNSCORED samples, V."""
    drive, measured = values[:, 0] + offset, values[:, 1]
    fine = signal.resample(np.concatenate([drive, drive[::-1]]), 4 * FINER * len(drive))[: 2 * FINER * len(drive)]
    head = fine[: 2 * FINER * UNSCORED]

    def early(start: Array) -> Array:
        return np.nan_to_num(free_run(model, head, rate, start) - measured[:UNSCORED], nan=1e3)

    slope = (measured[1] - measured[0]) * rate
    start = optimize.least_squares(early, [measured[0], slope], x_scale=[0.1, 40.0], diff_step=1e-4).x
    error: Array = free_run(model, fine, rate, start) - measured
    return error


def constant_force(model: Model, values: Array, rate: float) -> float:
    """Force that removes the mean error of the free run, V."""
    offset = 0.0
    for _ in range(2):
        offset -= model[2] * float(np.mean(_free_error(model, values, rate, offset)[UNSCORED:]))
    return offset


def free_run_error(model: Model, values: Array, rate: float, offset: float = 0.0) -> float:
    """Root mean square error of the free run beyond the first UNSCORED samples, V."""
    return float(np.sqrt(np.mean(_free_error(model, values, rate, offset)[UNSCORED:] ** 2)))
