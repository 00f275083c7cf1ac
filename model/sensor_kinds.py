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
    zero: float = 0.0  # standard deviation of an ordinary instrument's zero, in that unit


KINDS: dict[Kind, SensorKind] = {
    "acceleration": SensorKind("m/s^2", 0.01, "acceleration", zero=0.015),
    "velocity": SensorKind("m/s", 1e-3, "velocity", zero=1e-3),
    "displacement": SensorKind("m", 1e-5, "displacement", zero=1e-3),
    "roll_rate": SensorKind("rad/s", 1e-4, "velocity", "roll", zero=1e-3),
    "pitch_rate": SensorKind("rad/s", 1e-4, "velocity", "pitch", zero=1e-3),
    "deflection": SensorKind("m", 1e-5, "deflection", zero=1e-3),
    "force": SensorKind("N", 1.0, "force"),
}
USUAL_NOISE = {kind.unit: kind.noise for kind in KINDS.values()}  # by unit, of inputs too
USUAL_ZERO = {kind.unit: kind.zero for kind in KINDS.values()}
