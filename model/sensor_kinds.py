"""Kinds of sensors: what each shows of a body or an element.  A further kind is one more line here, and its name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MotionKind = Literal["acceleration", "velocity", "displacement", "roll_rate", "pitch_rate"]  # of a body
ElementKind = Literal["deflection", "force"]  # of an element
Kind = MotionKind | ElementKind
Shown = Literal["acceleration", "velocity", "displacement", "deflection", "force"]  # rows in `model.mechanics`


@dataclass(frozen=True)
class SensorKind:
    """What sensors of a kind show, and how well."""

    unit: str  # SI
    noise: float  # standard deviation of one sample of an ordinary instrument, in that unit
    shows: Shown
    axis: Literal["", "roll", "pitch"] = ""  # about which the body turns; empty: vertically, of a point of it


KINDS: dict[Kind, SensorKind] = {
    "acceleration": SensorKind("m/s^2", 0.01, "acceleration"),
    "velocity": SensorKind("m/s", 1e-3, "velocity"),
    "displacement": SensorKind("m", 1e-5, "displacement"),
    "roll_rate": SensorKind("rad/s", 1e-4, "velocity", "roll"),
    "pitch_rate": SensorKind("rad/s", 1e-4, "velocity", "pitch"),
    "deflection": SensorKind("m", 1e-5, "deflection"),
    "force": SensorKind("N", 1.0, "force"),
}
USUAL_NOISE = {kind.unit: kind.noise for kind in KINDS.values()}  # by unit, of inputs too
