"""Laws of the catalogue: parameters, force, and information for engineers.

An element law adds a force to the k d + c v of its element:

    f = k d + c v + law.force(motion, p, element)          N, positive in extension
    z' = law.memory_rate(motion, p, element)               for laws with memory

`force` and `memory_rate` are pure and work on arrays of any shape: d, v, t and every parameter only have to
broadcast, so that one call serves a whole record, a batch of candidates or one instant of a simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sprung.model.laws.channel import SensorResponse
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.signals import FloatArray

# "bodies": two bodies, or a body and a support or the ground; "axle": both supports of one
# "elements": all springs of a system together; "bodies": two of them; "every body": all together
Where = Literal["element", "elements", "pair", "body", "bodies", "every body", "sensor", "support", "axle"]
Channels = Literal["sensor", "support", "force"]
EXTENSION, COMPRESSION = "extension", "compression"  # forms of a law that acts in this direction alone
Values = Sequence[Any]  # one float or array per parameter, in the law's order; they broadcast with the motion


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One number of a law."""

    name: str
    unit: str
    low: float  # smallest admissible value
    high: float  # largest admissible value
    meaning: str
    typical: Callable[[Observed], float]  # size at which the law would matter, for scaling a fit
    log: bool = False  # positive by nature and of unknown order: fitted as a logarithm
    usual: tuple[float, float] = (0.0, float("inf"))  # range in multiples of `typical`, beyond which it is rare
    plausible: tuple[float, float] = (-float("inf"), float("inf"))  # beyond it the value stands for something else
    minor: bool = False  # shapes a corner without influence on the strength: omitted in sentences
    accuracy: float = 0.0  # of the value, no less than of `typical`: to which branches follow what it stands for

    def admits(self, value: float) -> bool:
        return bool(self.low <= value <= self.high)


# Evidence that a law needs besides, because it contains a commoner one or imitates it: odds of 400 to 1
RARE = 12.0


class Parametrised:
    """What is asked of every law; what only some kinds of laws have is absent here.

    Simulation and diagnosis ask a law for what it does, and compare none with a particular one.
    """

    name: str
    parameters: tuple[ParameterSpec, ...]
    absent: tuple[float, ...]
    where: Where
    prior_cost: float = 0.0  # evidence by which the law must beat commoner ones
    named: bool = True  # whether it is physics with a name
    listed: bool = True  # False: defined only by its formula or the map of its force
    fault: bool = False  # whether it is one of the measurement, not of the system
    nuisance: bool = False  # reported, and no reason for any verdict
    # Of some kinds of laws, where it is explained
    strength: int | None = 0
    memory: int = 0
    memory_decay: Callable[[Values, SpringDamper], Any] | None = None
    constant: bool = False
    branch: Callable[[Values, float], Maxwell] | None = None
    branches: Callable[[Values, SpringDamper], tuple[Maxwell, ...]] | None = None
    formula: str = ""
    memory_formula: str = ""
    corner: int | None = None
    knees: tuple[int, ...] = ()
    wider: ElementLaw | None = None
    load: Callable[[FloatArray, Values], FloatArray] | None = None
    scales: str = ""
    adds_motion: bool = False
    holds: str = ""
    response: Callable[[Values], SensorResponse] | None = None
    of_instrument: Callable[[DataSheet], float] | None = None

    @property
    def everywhere(self) -> bool:
        """Whether its one value holds for all springs, or all bodies, of a system."""
        return self.where in ("elements", "every body")

    @property
    def rounded(self) -> bool:
        """Whether one of its parameters rounds a corner of its force."""
        return any(spec.minor for spec in self.parameters)

    @property
    def of_formula(self) -> bool:
        """Whether it is defined by its formula only."""
        return not self.listed and bool(self.formula)

    @property
    def in_time(self) -> bool:
        """Whether its force is evaluated in time along the trajectory."""
        return False

    @property
    def linear(self) -> bool:
        """Whether a system with it is still a linear one, perhaps with one more force."""
        return False

    @property
    def part(self) -> bool:
        """Whether it is a linear structural part, many of which approximate any other structure.

        Wrong values of the file are none, nor is damping of all springs or bodies.
        """
        return False

    @property
    def drives(self) -> bool:
        """Whether it is an excitation of its own."""
        return self.load is not None

    @property
    def error_of_value(self) -> bool:
        """Whether it is an error of a value that the system file or a data sheet states, as every rig has some."""
        return bool(self.scales)

    @property
    def delays(self) -> bool:
        """Whether its only parameter is the delay of a channel, s."""
        return False

    @property
    def filters(self) -> bool:
        """Whether it is a filter of a channel, with a memory of its own."""
        return False

    @property
    def frequency(self) -> int | None:
        """The parameter that is its own frequency, Hz."""
        return next((i for i, spec in enumerate(self.parameters) if spec.unit == "Hz"), None)

    @property
    def strengths(self) -> tuple[int, ...]:
        """Parameters that scale its effect at constant shape; empty if there are none."""
        return ()

    @property
    def discriminated_by(self) -> str:
        """The experiment that would distinguish it from its look-alikes."""
        return "a longer recording, or one at a higher level (worse track, more speed or load),"

    def axis_in_words(self, variant: str) -> str:
        """The axis that a variant of it stands for."""
        return ""

    def slope(self) -> SensorResponse:
        """Derivative of its response by the first parameter, at none of the fault: what is no fault shows nothing."""
        return SensorResponse(0.0, 0.0, 0.0, 0.0)

    def scaled(self, p: Sequence[float], factor: float) -> FloatArray:
        """Parameters at `factor` times the strength; not clipped."""
        values = np.array(p, dtype=float)
        for index in self.strengths:
            values[index] = self.absent[index] + factor * (values[index] - self.absent[index])
        return values

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    def admits(self, p: Sequence[float]) -> bool:
        return all(q.admits(float(value)) for q, value in zip(self.parameters, p, strict=True))


class Maxwell(NamedTuple):
    """A spring and a damper in series beside an element, force s' = stiffness v - s / time."""

    stiffness: float  # N/m
    time: float  # s, damper over spring
    replaces: float = 0.0  # N s/m, the part of the element's damper in the branch
    of_spring: bool = False  # whether its stiffness is a share of the element's own


class FittedElement(NamedTuple):
    """An element as it was identified without a law."""

    stiffness: float  # N/m
    damping: float  # N s/m
    nominal_damping: float  # N s/m, of the system file
    frequency: float  # rad/s, rms rate over rms deflection
    rate: float  # m/s, rms


class Restart(NamedTuple):
    """Another start for a law that makes its element be misread: factors of the reading, and the law's parameters."""

    stiffness: float
    damping: float
    parameters: tuple[float, ...]


class Restatement(NamedTuple):
    """Another law that has the same force beside another spring and damper."""

    law: ElementLaw
    parameters: tuple[float, ...]
    element: SpringDamper


def empty_memory(motion: Motion, p: Values, element: SpringDamper) -> Any:
    """A memory that knows nothing of the time before the recording."""
    return 0.0


def no_memory(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    """Rate of the memory of a law that has none, (0, ...)."""
    return np.zeros((0, *np.shape(motion.deflection)))


@dataclass(frozen=True)
class ElementLaw(Parametrised):
    """A force that an element may have besides k d + c v (module docstring)."""

    name: str
    title: str  # in an engineer's words, without article: "dry friction"
    parameters: tuple[ParameterSpec, ...]
    force: Callable[[Motion, Values, SpringDamper], Any]  # N, added to k d + c v
    shapes: Callable[[Observed], FloatArray]  # trial values for screening, shape (trials, P)
    absent: tuple[float, ...]  # parameter values at which the law vanishes
    looks_like: str
    confused_with: tuple[str, ...]  # names of laws that similar data may suggest
    sentence: str  # "dry friction of {force}"; each {parameter} becomes "395 +- 6 N"
    strength: int | None = 0  # parameter in which the force is linear, counted from its `absent` value; None: none is
    where: Where = "element"
    memory: int = 0  # states of its own
    memory_rate: Callable[[Motion, Values, SpringDamper], FloatArray] = no_memory  # shape (memory, ...)
    memory_start: Callable[[Motion, Values, SpringDamper], Any] = empty_memory  # at the first sample
    # The same along a whole motion (T, ...), quicker: of a sample and the memory there
    memory_rates: Callable[[Motion, Values], Callable[[int, FloatArray], FloatArray]] | None = None
    # Fast linear decay of each state, 1/s, shape (memory, ...), integrated exactly: rate + decay * state depends on the
    # motion alone
    memory_decay: Callable[[Values, SpringDamper], Any] | None = None
    # Deflection over which a memory turns, m: a simulation takes no longer steps; None: as the element's modes need
    turns_over: Callable[[Values], Any] | None = None
    # A law that is a linear element with memory: parameters and the element's damping -> its branch
    branch: Callable[[Values, float], Maxwell] | None = None
    # Force along a whole evenly sampled motion (T,), faster than stepping; None: by the rate of the memory
    path: Callable[[Motion, Values], FloatArray] | None = None
    restarts: Callable[[FittedElement], tuple[Restart, ...]] | None = None  # besides the start that screening finds
    # Other parameters that look alike on the whole, and from which a fit that leaves much starts once more
    alike: Callable[[Values], tuple[tuple[float, ...], ...]] | None = None
    prior_cost: float = 0.0
    named: bool = True
    listed: bool = True
    nuisance: bool = False
    screened: bool = True  # sought in systems of bodies; else only where the force of its element is measured
    at: tuple[str, ...] = ()  # elements that it may act at; empty: all
    over_time: bool = False  # whether its force depends on the time since the recording began
    corner: int | None = None  # parameter that is the width of a corner over the rate, m/s
    knees: tuple[int, ...] = ()  # parameters that are rates at which the slope changes, m/s
    wider: ElementLaw | None = None  # the same with more parameters after its own: tried beside it where it is found
    # Of a wider law that is tried in place of the narrower one once that is found: starts, from that one's values
    widened: Callable[[Values, Observed], Sequence[Values]] | None = None
    # Other laws with the same force beside another spring and damper than its values and its element's: where the one
    # beside it is far from nominal, they are tried in its place
    restated: Callable[[Values, SpringDamper], tuple[Restatement, ...]] | None = None
    # Variants with the same parameters, sought as well; those of either direction may stand beside each other
    forms: tuple[tuple[str, ElementLaw], ...] = ()
    formula: str = ""  # the force as text (model.laws.expression), for export; empty: cannot be written down
    memory_formula: str = ""  # the rate of its one state `z`, likewise
    parts: tuple[tuple[str, str], ...] = ()  # both of every part, where the force is a sum of such
    constant: bool = False  # a force that no motion changes: in the model of every component test

    @property
    def in_time(self) -> bool:
        return self.branch is None

    @property
    def linear(self) -> bool:
        return self.memory_decay is not None

    @property
    def part(self) -> bool:
        return self.linear

    @property
    def strengths(self) -> tuple[int, ...]:
        return () if self.strength is None or not self.named else (self.strength,)

    @property
    def discriminated_by(self) -> str:
        if self.memory:
            return "a recording at another speed, so that the same deflections come at other rates,"
        return super().discriminated_by

    def clip(self, p: Sequence[float]) -> FloatArray:
        """Nearest admissible values, shape (P,)."""
        return np.array([min(max(float(v), q.low), q.high) for q, v in zip(self.parameters, p, strict=True)])

    def scaled(self, p: Sequence[float], factor: float) -> FloatArray:
        """Parameters whose force is `factor` times that of `p` where the law is linear, else `p`; not clipped."""
        values = np.array(p, dtype=float)
        if self.strength is not None:
            zero = self.absent[self.strength]
            values[self.strength] = zero + factor * (values[self.strength] - zero)
        return values


def with_wider_form(law: ElementLaw, *further: ParameterSpec, **changes: Any) -> ElementLaw:
    """A law that has a wider form: the same with `further` parameters after its own, and other `changes`."""
    return replace(law, wider=replace(law, parameters=(*law.parameters, *further), **changes))


def grid(*columns: Sequence[float] | FloatArray) -> FloatArray:
    """Every combination of the columns' values, shape (trials, columns)."""
    mesh = np.meshgrid(*[np.asarray(column, dtype=float) for column in columns], indexing="ij")
    return np.stack([axis.ravel() for axis in mesh], axis=-1)


class DataSheet(NamedTuple):
    """Tolerances of an intact instrument, as standard deviations, and the size of its signal."""

    gain: float  # relative
    zero: float  # in the channel's unit
    delay: float  # s
    size: float  # standard deviation of its signal, in the channel's unit
    step: float  # s, from sample to sample
