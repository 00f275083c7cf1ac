"""What of a system is estimated: parameters, loads of bodies, and what data sheets leave to channels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown: `primary_11l.stiffness`, `car.mass`."""

    name: str
    element: str  # the element, or the body of a mass
    quantity: str  # stiffness | damping | mass
    unit: str
    nominal: float


@dataclass(frozen=True, slots=True)
class LoadState:
    """A body whose mass varies; its inertias vary with it."""

    name: str  # "car.load"
    body: str
    empty: float  # kg, the mass of the system file
    declared: bool  # stated in the system file
    std: float  # of the logarithm of mass over `empty`, before any window
    least: float | None = None  # kg that it may carry beside `empty`, by the system file
    most: float | None = None


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Standard deviations that a data sheet leaves to one channel."""

    gain: float  # relative
    delay: float  # s
    zero: float = 0.0  # in the unit of the channel
