"""Laws of bodies, of the structure, of supports and of sensors; those of elements are in `base`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval

from sprung.model.laws.base import Channels, DataSheet, ElementLaw, Maxwell, ParameterSpec, Parametrised, Values, Where
from sprung.model.laws.channel import SensorResponse, passed, undone
from sprung.model.laws.motion import SpringDamper
from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class BodyLaw(Parametrised):
    """Physics of a body: it changes the mechanics, or applies an unmeasured force to a degree of freedom."""

    name: str
    title: str
    parameters: tuple[ParameterSpec, ...]
    variants: Callable[[Mechanics, int], tuple[str, ...]]  # discrete choices: a mode's shape, a direction
    # The mechanics with the law: same signature for all; `mechanics.stiffness` etc. hold the present values
    modify: Callable[[Mechanics, int, Values, str], Mechanics]
    shapes: Callable[[Sequence[float]], FloatArray]  # trial values, from the frequencies of lines in the residual, Hz
    absent: tuple[float, ...]
    looks_like: str
    confused_with: tuple[str, ...]
    sentence: str
    load: Callable[[FloatArray, Values], FloatArray] | None = None  # N over the laws' clock: one more force in u
    scales: str = ""  # quantity of the body that the only parameter multiplies: no candidate where that is estimated
    # Powers of parameters, by their index, with which stiffness and damping of the element that the law adds grow
    powers: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    adds_motion: bool = False  # whether it brings a degree of freedom of its own
    prior_cost: float = 0.0
    where: Where = "body"

    @property
    def linear(self) -> bool:
        return True


class Foothold(NamedTuple):
    """What a change of the structure takes hold of, by its index in the mechanics."""

    kind: Literal["body", "support", "element", "ground"]
    number: int  # 0 of the ground


@dataclass(frozen=True)
class StructureLaw(Parametrised):
    """A part that the structure has and its file does not state, or states elsewhere: it changes the mechanics.

    Linear, so that nothing of it is found along the trajectory.
    """

    name: str
    title: str
    parameters: tuple[ParameterSpec, ...]
    where: Where  # "body", "bodies", "every body", "element" or "elements"
    # The mechanics with the law, of the sites that its location names; `variant` as in a term
    modify: Callable[[Mechanics, tuple[Foothold, ...], Values, str], Mechanics]
    absent: tuple[float, ...]
    looks_like: str
    confused_with: tuple[str, ...]
    sentence: str
    variants: tuple[str, ...] = ("",)  # discrete choices: an axis
    axes: Mapping[int, str] = field(default_factory=dict)  # parameters that are a place along "x" or "y", m
    powers: Mapping[int, tuple[float, float]] = field(default_factory=dict)  # as of a `BodyLaw`
    adds_motion: bool = False  # whether it brings a degree of freedom of its own
    strengths: tuple[int, ...] = ()  # parameters in which it is linear at first order, together 0 where it is absent
    # Derivative of its element's deflection that its force goes with, by its only parameter: 0, 1, 2; None: another way
    along: int | None = None
    # What engineers quote of a structure that has it: name -> (value, unit)
    quoted: Callable[[Mechanics], dict[str, tuple[float, str]]] | None = None
    holds: str = ""  # quantity of the element that the system file must hold: no candidate where that is estimated
    # What it puts beside every spring that its location names; the mechanics stay as they are
    branches: Callable[[Values, SpringDamper], tuple[Maxwell, ...]] | None = None
    prior_cost: float = 0.0
    fault: bool = False

    @property
    def linear(self) -> bool:
        return True

    @property
    def part(self) -> bool:
        return not self.holds and not self.everywhere

    def axis_in_words(self, variant: str) -> str:
        return f", along {variant}" if variant else ""


@dataclass(frozen=True)
class SupportLaw(Parametrised):
    """A movement of supports that repeats itself and that their measured motion does not show.

    movement = depth sum_n harmonics[n - 1] cos(2 pi n (frequency t - phase)), t on the laws' clock
    """

    name: str
    title: str
    parameters: tuple[ParameterSpec, ...]  # depth m, frequency Hz, phase in periods
    harmonics: tuple[float, ...]  # per unit of depth, from the fundamental on
    absent: tuple[float, ...]
    looks_like: str
    confused_with: tuple[str, ...]
    sentence: str
    where: Where = "support"  # "axle": both supports of one axle together
    prior_cost: float = 0.0

    @property
    def drives(self) -> bool:
        return True

    def movement(self, time: FloatArray, p: Values, highest: float = np.inf) -> tuple[FloatArray, FloatArray]:
        """What is added to the measured displacement (m) and velocity (m/s) at times on the laws' clock, each (T,).

        highest: Hz, harmonics above it are left out, as anti-alias filters do.
        """
        depth, frequency, phase = p
        n = np.arange(len(self.harmonics) + 1)
        weights = depth * np.where(n * frequency < highest, (0.0, *self.harmonics), 0.0)
        turn = np.exp(2j * np.pi * (np.asarray(time) * frequency - phase))
        displacement, rate = polyval(turn, np.column_stack([weights, 2j * np.pi * n * frequency * weights]))
        return displacement.real, rate.real

    def displacements(
        self, time: FloatArray, frequency: float, phases: FloatArray, highest: float = np.inf
    ) -> FloatArray:
        """Displacement of `movement` per unit of depth, of one frequency at several phases (m,) at once, (m, T)."""
        n = np.arange(1, len(self.harmonics) + 1)
        weights = np.where(n * frequency < highest, self.harmonics, 0.0)
        powers = np.multiply.accumulate(np.tile(np.exp(2j * np.pi * frequency * time), (len(n), 1)), axis=0)
        shifted = weights * np.exp(-2j * np.pi * np.outer(phases, n))
        found: FloatArray = shifted.real @ powers.real - shifted.imag @ powers.imag
        return found


def _as_large_as_found(step: float, amplitude: float) -> float:
    return max(abs(amplitude), 1e-9)


@dataclass(frozen=True)
class SensorLaw(Parametrised):
    """A fault of a measurement: the shown signal as a function of the true one.

    The response defines the law; distortion, correction and sensitivities follow from it.
    """

    name: str
    title: str
    parameters: tuple[ParameterSpec, ...]
    absent: tuple[float, ...]
    looks_like: str
    confused_with: tuple[str, ...]
    sentence: str
    response: Callable[[Values], SensorResponse] | None = None  # None: not a function of the truth (noise, stuck)
    at: tuple[Channels, ...] = ()  # which channels are screened for it
    scale: Callable[[float, float], float] = _as_large_as_found  # of a step's length (s) and the amplitude found
    # Of a filter: values with which it is sought, (trials, P), from the lowest and the highest frequency that shows, Hz
    trials: Callable[[float, float], FloatArray] | None = None
    shared: bool = False  # whether instruments of a kind usually have the same one, and it is sought for all of them
    kinds: tuple[str, ...] = ()  # of sensors that may have it; empty: all
    forms: Mapping[str, SensorLaw] = field(default_factory=dict)  # other models of the same effect, by variant
    where: Where = "sensor"  # "axle": all inputs of one axle together
    stuck: bool = False  # the channel repeats its first value
    scales_noise: bool = False  # its only parameter is the channel's noise over the noise declared
    prior_cost: float = 0.0
    fault: bool = True
    # Deviation of the only parameter in an instrument in order; None: no instrument has the fault
    of_instrument: Callable[[DataSheet], float] | None = None

    @property
    def error_of_value(self) -> bool:
        return True

    @property
    def filters(self) -> bool:
        return self.trials is not None

    @property
    def delays(self) -> bool:
        alone = self.response is not None and len(self.parameters) == 1
        return alone and not self.filters and self.slope() == SensorResponse(0.0, 0.0, 1.0, 0.0)

    @property
    def discriminated_by(self) -> str:
        return "a calibration of the sensor"

    def distort(self, truth: FloatArray, p: Values, sample_rate: float) -> FloatArray:
        """What is shown of the truth (..., T) along the last axis."""
        if self.stuck:
            return np.broadcast_to(truth[..., :1], np.shape(truth)).copy()
        return truth if self.response is None else passed(truth, self.response(p), sample_rate)

    def restore(self, shown: FloatArray, p: Values, sample_rate: float) -> FloatArray:
        """The true signal of a shown one (..., T).  Errors: `ValueError` if it cannot be restored."""
        if self.stuck:
            raise ValueError(f"{self.name}: nothing is left of the signal")
        return shown if self.response is None else undone(shown, self.response(p), sample_rate)

    def combined(self, first: float, second: float) -> float:
        """The only parameter of two faults one after the other."""
        return first * second if self.absent[0] else first + second

    def slope(self) -> SensorResponse:
        """Derivative of the response by the first parameter, at none of the fault; no fault's where it filters."""
        if self.response is None:
            raise ValueError(f"{self.name} has no response")
        if self.filters:
            return super().slope()
        here, there = (self.response((self.absent[0] + step, *self.absent[1:])) for step in (0.0, 1.0))
        return SensorResponse(*(getattr(there, one) - getattr(here, one) for one in ("gain", "lag", "delay", "offset")))


Law = ElementLaw | BodyLaw | StructureLaw | SupportLaw | SensorLaw
