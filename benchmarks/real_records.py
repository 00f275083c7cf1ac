"""Measured records of other people's rigs as columns and system files: what `sprung bench real` runs.

A record is known by its file's name and content; nothing of a rig's physics is told beyond what is connected to what.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.signal import decimate

from sprung.model.system import System, parse_system

Array = NDArray[np.float64]
INCH, KIP = 0.0254, 4448.22
EMPS_FINER, DROPBEAR_FINER = 4, 20  # native rates over those that are diagnosed


@dataclass(frozen=True)
class MeasuredRecord:
    """Columns of one record in the order of its system's channels; what a diagnosis needs of a recording."""

    name: str
    system: System
    values: Array  # (T, C), SI units
    sample_rate: float
    lost: int = 0
    component: bool = False  # displacement [, velocity], force of one element: references can be fitted
    independent: Array | None = None  # what no diagnosis sees and a natural frequency must follow, (T,)


def component(name: str, rate: float, velocity: bool) -> System:
    """One element between a rod whose motion is measured and ground, and a force cell."""
    more = ", velocity: {csv: velocity}" if velocity else ""
    return parse_system(f"""
name: {name}
sample_rate: {rate:g}
window: 64
inputs:
  rod: {{kind: displacement, displacement: {{csv: displacement}}{more}}}
elements:
  damper: {{upper: rod, lower: ground, stiffness: 1.0e+3, damping: 1.0e+3}}
sensors:
  cell: {{kind: force, element: damper, csv: force}}
""")


def magneto_rheological(path: Path) -> MeasuredRecord:
    """labcontrol-data/mr-damper: stroke in mm, force in N."""
    data = loadmat(path)
    values = np.column_stack([1e-3 * np.ravel(data["dist"]), np.ravel(data["forc"])]).astype(float)
    rate = 100.0
    return MeasuredRecord(path.stem, component("magneto-rheological damper", rate, False), values, rate, component=True)


def friction_backlash(path: Path) -> MeasuredRecord:
    """ARTS-Laboratory: time, displacement (in), friction force (kip), velocity (in/s)."""
    data = json.loads(path.read_text(encoding="utf-8"))
    table = np.array(data["data"], dtype=float)
    values = np.column_stack([INCH * table[:, 1], INCH * table[:, 3], KIP * table[:, 2]])
    rate = float(data["sampling freq"])
    system = component("banded rotary friction damper", rate, True)
    return MeasuredRecord(path.stem, system, values, rate, component=True)


def positioning_axis(path: Path) -> MeasuredRecord:
    """EMPS: motor voltage times its gain is a force on the slide; its encoder."""
    data = loadmat(path)
    force = np.ravel(data["vir"]) * float(np.ravel(data["gtau"])[0])
    columns = [decimate(np.ravel(series), EMPS_FINER, ftype="fir") for series in (force, data["qm"])]
    rate = 1000.0 / EMPS_FINER
    text = (Path(__file__).parent / "systems" / "emps.yaml").read_text(encoding="utf-8")
    text = text.replace("sample_rate: 1000", f"sample_rate: {rate:g}")
    return MeasuredRecord(path.stem, parse_system(text), np.column_stack(columns), rate)


def cantilever(path: Path) -> MeasuredRecord:
    """DROPBEAR: the acceleration of a beam whose support moves; nobody measured what excites it."""
    table = np.genfromtxt(path, skip_header=9, invalid_raise=False)
    rate = 5000.0 / DROPBEAR_FINER
    acceleration, pin = (
        decimate(table[np.isfinite(table[:, 1]), column], DROPBEAR_FINER, ftype="fir") for column in (1, 2)
    )
    system = parse_system(f"""
name: cantilever
sample_rate: {rate:g}
window: 125
bodies: {{tip: {{mass: {{value: 1.0, fixed: true}}}}}}
elements: {{beam: {{upper: tip, lower: ground, stiffness: 4.5e+4, damping: 10.0}}}}
sensors: {{tip: {{kind: acceleration, body: tip, csv: acceleration, noise: 2.0e-3}}}}
""")
    return MeasuredRecord(path.stem, system, acceleration[:, None], rate, independent=pin)


READERS: tuple[tuple[str, Callable[[Path], MeasuredRecord]], ...] = (
    ("mr_damper*.mat", magneto_rheological),
    ("brfd*.json", friction_backlash),
    ("*EMPS*.mat", positioning_axis),
    ("dropbear*.txt", cantilever),
)


def records(folder: Path) -> Iterator[MeasuredRecord]:
    """Every known record in a folder.

    Raises ValueError when there is none.
    """
    found = False
    for pattern, reader in READERS:
        for path in sorted(folder.glob(pattern)):
            found = True
            yield reader(path)
    if not found:
        known = ", ".join(pattern for pattern, _ in READERS)
        raise ValueError(f"{folder}: no known record there; known are {known} (docs/mismatch.md says where from)")
