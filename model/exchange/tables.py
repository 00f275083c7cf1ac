"""Force tables of elements for multibody programs: F(d) at rest, F(v) through the middle, as CSV."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from sprung.model.exchange.statespace import ExchangeError
from sprung.model.laws import ElementLaw, Motion, SpringDamper
from sprung.model.laws.placed import PlacedLaw
from sprung.model.signals import FloatArray
from sprung.model.system import System

POINTS = 201


def write_tables(folder: Path, system: System, deflection: float, rate: float) -> list[Path]:
    """One CSV per element and axis up to `deflection` (m) and `rate` (m/s): motion, force of spring or damper and laws.

    Elements whose laws have no such curve are left out; `ExchangeError` where none is left, before anything is written.
    """
    without = without_curve(system)
    if len(without) == len(system.elements):
        raise ExchangeError(f"laws at {', '.join(without)} remember or change over time: no curve is left")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for index, element in enumerate(system.elements):
        if element in without:
            continue
        laws = [law for law in system.laws if isinstance(law.law, ElementLaw) and law.places == (element,)]
        k, c = system.mechanics.stiffness[index], system.mechanics.damping[index]
        for axis, most in (("d", deflection), ("v", rate)):
            motion = np.linspace(-most, most, POINTS)
            zero = np.zeros_like(motion)
            d, v = (motion, zero) if axis == "d" else (zero, motion)
            force = k * d + c * v + _of_laws(laws, d, v, SpringDamper(k, c))
            path = folder / f"{element}-{axis}.csv"
            with path.open("w", newline="", encoding="utf-8") as stream:
                table = csv.writer(stream)
                table.writerow(["deflection_m" if axis == "d" else "rate_m_per_s", "force_N"])
                table.writerows(zip((f"{x:.9g}" for x in motion), (f"{f:.9g}" for f in force), strict=True))
            written.append(path)
    return written


def without_curve(system: System) -> list[str]:
    """Elements whose force is no function of deflection or rate alone: a law there remembers, or changes over time."""
    following = [
        placed.places
        for placed in system.laws
        if isinstance(placed.law, ElementLaw) and (placed.law.memory or placed.law.over_time)
    ]
    return [element for element in system.elements if any(element in places for places in following)]


def _of_laws(laws: list[PlacedLaw], d: FloatArray, v: FloatArray, element: SpringDamper) -> FloatArray:
    total = np.zeros_like(d)
    for placed in laws:
        law = placed.law
        assert isinstance(law, ElementLaw)
        total = total + law.force(Motion(d, v), placed.values, element)
    return total
