"""`sprung bench emps --data DIR`: missing physics in a measured electro-mechanical positioning axis.

The record is that of nonlinearbenchmark.org; DIR holds closed_loop.csv with the columns time, force and position.
The tool sees a mass on a damper.  The published values come from inverse dynamics and ordinary least squares with
the complete model known: mass 95.11 kg, viscous 203.50 N s/m, Coulomb 20.39 N, offset of the force -3.16 N.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.inverse_dynamics import force_error
from sprung.benchmarks.silverbox import data_file, diagnosis_of
from sprung.model.signals import FloatArray
from sprung.model.system import load_system
from sprung.replay.record import load_record

SYSTEM = Path(__file__).parent / "systems" / "emps.yaml"
PUBLISHED = {"mass": 95.11, "viscous": 203.50, "coulomb": 20.39, "offset": -3.16}
TOLERANCE = 0.03


def run(data: Path, out: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yields the diagnosis and every published value beside the identified one."""
    system = load_system(SYSTEM)
    path = data_file(data, "closed_loop.csv")
    record = load_record(path, system.channels, system.sample_rate, time=system.time)
    said = diagnosis_of(system, record, path.name, out)
    yield {
        "verdict": said["verdict"],
        "findings": said["findings"],
        "explained": said["explained"],
        "viscous_without_friction": identified(said, "baseline").get("viscous"),
    }
    found = identified(said, "augmented")
    yield {"value": "force_rmse"} | force_errors(record.values, record.sample_rate, found)
    for name, target in PUBLISHED.items():
        value = found.get(name)
        error = None if value is None else value / target - 1
        yield {
            "value": name,
            "identified": value,
            "published": target,
            "relative_error": error,
            "met": error is not None and abs(error) <= TOLERANCE,
        }


def force_errors(values: FloatArray, rate: float, found: Mapping[str, float | None]) -> dict[str, float]:
    """RMS of the force (N) that the identified and the published model leave, of columns force and position."""
    known = {name: value for name, value in found.items() if value is not None}
    force, position = values[np.isfinite(values).all(axis=1)].T
    models = {"identified": known, "published": PUBLISHED}
    return {name: force_error(force, position, rate, model) for name, model in models.items()}


def identified(said: dict[str, Any], key: str) -> dict[str, float]:
    """Mass and viscous friction of a stage of the report, and the findings' Coulomb force and offset."""
    values = {p["name"]: p["value"] for p in said[key]["parameters"]}
    found = {"mass": values["slide.mass"], "viscous": values["guide.damping"]}
    for finding in said["findings"] if key == "augmented" else ():
        first = finding["parameters"][0]["value"] if finding["parameters"] else None
        if (finding["location"], finding["effect"]) == ("guide", "coulomb_friction"):
            found["coulomb"] = first
        elif finding["effect"] == "sensor_bias" and finding["location"].startswith("motor"):
            found["offset"] = first
    return found
