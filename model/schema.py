"""Schema of the system file.

A lumped mechanical system in YAML, SI units, x forward, y left, z up.  Format: docs/system-file.md; reading it:
`model.systemfile`.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints, model_validator

from sprung.model.address import LARGEST, SMALLEST, Address, Laws, Strict, TimeKey, zero_or_seen
from sprung.model.sensor_kinds import KINDS, ElementKind, MotionKind
from sprung.model.units import FACTORS, UnitError, known


class SystemFileError(ValueError):
    """The system file cannot be used; `problems` has one line each, with key, line and what to do."""

    def __init__(self, message: str, problems: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.problems = problems or (message,)


class Value(Strict):
    """A physical value; `fixed` ones are never estimated."""

    value: Annotated[float, AfterValidator(zero_or_seen)] = Field(ge=0, le=LARGEST)
    fixed: bool = False


def _as_value(raw: Any) -> Any:
    return {"value": raw} if isinstance(raw, (int, float)) and not isinstance(raw, bool) else raw


Quantity = Annotated[Value, BeforeValidator(_as_value, json_schema_input_type=float | Value)]


class MassValue(Value):
    """A mass, with its standard deviation if windows do not determine it."""

    std: float | None = Field(default=None, ge=0)  # kg, standard deviation; inertias go along


Mass = Annotated[MassValue, BeforeValidator(_as_value, json_schema_input_type=float | MassValue)]
MOST_BODIES = 200  # the time to check that sensors see every mode goes with the fourth power
Point = tuple[float, float]
GROUND = "ground"  # the fixed support, of every system
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class Load(Strict):
    """A body whose mass varies from ride to ride; its inertias vary with it."""

    min: float | None = None  # kg beside the nominal mass
    max: float | None = None  # kg
    pressure: Address | None = None  # of the air springs, Pa

    @model_validator(mode="after")
    def _in_order(self) -> Load:
        if self.min is not None and self.max is not None and self.min >= self.max:
            raise ValueError("min must be less than max")
        return self


def _as_load(raw: Any) -> Any:
    return {True: {}, False: None}[raw] if isinstance(raw, bool) else raw


class Body(Strict):
    """A rigid body: heaves; with inertias it also rolls and pitches about `position`."""

    mass: Mass  # kg
    roll_inertia: float | None = Field(default=None, ge=SMALLEST, le=LARGEST)  # kg m^2
    pitch_inertia: float | None = Field(default=None, ge=SMALLEST, le=LARGEST)  # kg m^2
    position: Point = (0.0, 0.0)  # m
    laws: Laws = ()
    load: Annotated[Load | None, BeforeValidator(_as_load, json_schema_input_type=bool | Load | None)] = None

    @model_validator(mode="after")
    def _has_mass(self) -> Body:
        if self.mass.value <= 0:
            raise ValueError("mass must be greater than 0")
        return self


class SupportInput(Strict):
    """A measured moving support, by any of its displacement, velocity and acceleration."""

    kind: Literal["displacement", "support"]
    displacement: Address | None = None  # m
    velocity: Address | None = None  # m/s
    acceleration: Address | None = None  # m/s^2
    laws: Laws = ()

    @model_validator(mode="after")
    def _is_measured(self) -> SupportInput:
        if not self.measured:
            raise ValueError("give at least one of displacement, velocity, acceleration (or kind: track)")
        return self

    @property
    def measured(self) -> dict[str, Address]:
        """The measured quantities, in the order of their channels."""
        signals = {
            "displacement": self.displacement,
            "velocity": self.velocity,
            "acceleration": self.acceleration,
        }
        return {quantity: address for quantity, address in signals.items() if address is not None}


class TrackInput(Strict):
    """An unmeasured support: a wheel on one of the rails, excited like the wheels ahead with a delay."""

    kind: Literal["track"]
    rail: Literal["left", "right"]
    position: Point  # m, of the wheel
    laws: Laws = ()


class ForceInput(Address):
    """A measured force on a body."""

    kind: Literal["force"]
    body: str
    position: Point | None = None


Input = Annotated[SupportInput | TrackInput | ForceInput, Field(discriminator="kind")]


class Element(Strict):
    """Spring and damper in parallel; deflection is upper minus lower."""

    upper: str
    lower: str
    position: Point | None = None
    stiffness: Quantity = Value(value=0.0, fixed=True)  # N/m
    damping: Quantity = Value(value=0.0, fixed=True)  # N s/m
    by_load: float = Field(default=0.0, ge=0, le=2)  # power of the load that the stiffness grows with; air spring: 1
    laws: Laws = ()
    depends_on: tuple[str, ...] = ()  # measured `signals` that its stiffness, damping and laws may follow


class MotionSensor(Address):
    """Vertical motion of a point of a body, or how the body turns about an axis (rad/s)."""

    kind: MotionKind
    body: str
    position: Point | None = None


class ElementSensor(Address):
    """Deflection (m) of an element, or the force (N) it carries, positive in extension."""

    kind: ElementKind
    element: str


Sensor = Annotated[MotionSensor | ElementSensor, Field(discriminator="kind")]
EstimatedQuantity = Literal["stiffness", "damping", "mass"]


class Speed(Address):
    """The vehicle's speed: measured, or constant."""

    value: float | None = Field(default=None, gt=0)  # m/s


class FollowedSignal(Address):
    """A measured signal that moves and weighs nothing: a valve's voltage, a temperature.  `unit` is only its name."""


class SystemFile(Strict):
    """The contents of a system file, with checked references between its parts."""

    name: Annotated[str, Field(min_length=1, max_length=200), StringConstraints(strip_whitespace=True)]
    sample_rate: float = Field(gt=0, le=1e6)  # Hz
    window: int = Field(ge=8, le=10_000)  # samples, the paper's tau
    hop: int | None = Field(default=None, ge=1)  # samples between window starts; default half a window
    time: TimeKey = TimeKey()
    speed: Annotated[Speed | None, BeforeValidator(_as_value, json_schema_input_type=float | Speed | None)] = None
    temperature: Address | None = Field(default=None, description="of the air, or of the bogie: degC, K or degF")
    yaw_rate: Address | None = Field(default=None, description="of the car or a bogie, rad/s: curves")
    lateral_acceleration: Address | None = Field(default=None, description="of the car or a bogie: curves")
    bodies: dict[Name, Body] = Field(default_factory=dict, max_length=MOST_BODIES)
    inputs: dict[Name, Input] = Field(default_factory=dict)
    elements: dict[Name, Element] = Field(default_factory=dict)
    sensors: dict[Name, Sensor] = Field(min_length=1)
    signals: dict[Name, FollowedSignal] = Field(default_factory=dict)
    estimate: tuple[EstimatedQuantity, ...] = ("stiffness", "damping")

    @model_validator(mode="after")
    def _references_exist(self) -> SystemFile:
        problems = [*Parts.of(self).problems(), *self._unknown_signals()]
        if len(set(self.estimate)) != len(self.estimate):
            problems.append("estimate: a quantity is listed twice")
        if self.hop is not None and self.hop > self.window:
            problems.append(f"hop: {self.hop} samples is longer than the window of {self.window}")
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def _unknown_signals(self) -> Iterator[str]:
        for name, element in self.elements.items():
            for signal in element.depends_on:
                yield from _missing(signal, self.signals, f"elements.{name}.depends_on", "a signal")
        for name in self.signals:
            if name in {**self.bodies, **self.inputs, **self.elements, **self.sensors}:
                yield f"signals.{name}: another part of the file has this name already"


SI: dict[str, str] = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "mass": "kg",
    **{name: kind.unit for name, kind in KINDS.items()},
    "pressure": "Pa",
    "speed": "m/s",
    "temperature": "degC",
    "yaw_rate": "rad/s",
    "lateral_acceleration": "m/s^2",
}


RUNNING = ("temperature", "yaw_rate", "lateral_acceleration")  # how the vehicle runs, measured beside `speed`


@dataclass(frozen=True)
class Parts:
    """The parts of a system file whose references are checked; None: the part itself is wrong, only its name counts."""

    bodies: Mapping[str, Body | None]
    inputs: Mapping[str, SupportInput | TrackInput | ForceInput | None]
    elements: Mapping[str, Element | None]
    sensors: Mapping[str, MotionSensor | ElementSensor | None]
    time: TimeKey | None
    speed: Speed | None
    estimate: Collection[str]
    running: Mapping[str, Address | None] = field(default_factory=dict)  # temperature, yaw_rate ...

    @staticmethod
    def of(file: SystemFile) -> Parts:
        """Those of a file."""
        return Parts(
            file.bodies,
            file.inputs,
            file.elements,
            file.sensors,
            file.time,
            file.speed,
            file.estimate,
            {key: getattr(file, key) for key in RUNNING},
        )

    def problems(self) -> Iterator[str]:
        """Errors, each as `key: error`."""
        yield from self._names()
        yield from self._elements()
        for name, source in self.inputs.items():
            if isinstance(source, ForceInput):
                yield from _missing(source.body, self.bodies, f"inputs.{name}.body", "a body")
        for name, sensor in self.sensors.items():
            if isinstance(sensor, ElementSensor):
                yield from _missing(sensor.element, self.elements, f"sensors.{name}.element", "an element")
            elif sensor is not None:
                yield from _missing(sensor.body, self.bodies, f"sensors.{name}.body", "a body")
                yield from self._turns(name, sensor)
        yield from self._units()

    def _names(self) -> Iterator[str]:
        for group, members in (("bodies", self.bodies), ("inputs", self.inputs)):
            if GROUND in members:
                yield f"{group}.{GROUND}: the name {GROUND} is reserved for the fixed support"
        for name in self.inputs:
            if name in self.bodies:
                yield f"inputs.{name}: a body has this name already"
            if name in self.sensors:
                yield f"sensors.{name}: an input has this name already"

    def _elements(self) -> Iterator[str]:
        supports = {name for name, source in self.inputs.items() if not isinstance(source, ForceInput)}
        tested = {s.element for s in self.sensors.values() if isinstance(s, ElementSensor) and s.kind == "force"}
        for name, element in self.elements.items():
            if element is None:
                continue
            for side in ("upper", "lower"):
                end = getattr(element, side)
                yield from _missing(
                    end, {*self.bodies, *supports, GROUND}, f"elements.{name}.{side}", "a body, a support or ground"
                )
            if element.upper == element.lower:
                yield f"elements.{name}.lower: both ends are {element.upper!r}"
            elif {element.upper, element.lower} <= {*supports, GROUND} - self.bodies.keys() and name not in tested:
                yield (
                    f"elements.{name}.upper: neither end is a body, so the element moves nothing; "
                    "with a force sensor on it, it is a component test"
                )
            for quantity in ("stiffness", "damping"):
                value = getattr(element, quantity)
                if quantity in self.estimate and not value.fixed and value.value == 0:
                    yield (
                        f"elements.{name}.{quantity}: a nominal value of 0 cannot be estimated; "
                        "give a rough positive value or {value: 0.0, fixed: true}"
                    )

    def _turns(self, name: str, sensor: MotionSensor) -> Iterator[str]:
        """A sensor of rotation needs a body that turns about its axis."""
        axis, body = KINDS[sensor.kind].axis, self.bodies.get(sensor.body)
        if axis and body is not None and getattr(body, f"{axis}_inertia") is None:
            yield f"sensors.{name}.body: {sensor.body} has no {axis}_inertia, so it does not {axis}"

    def addresses(self) -> Iterator[tuple[str, str, Address]]:
        """Key, quantity and address of every signal."""
        for name, source in self.inputs.items():
            if isinstance(source, SupportInput):
                for quantity, address in source.measured.items():
                    yield f"inputs.{name}.{quantity}", quantity, address
            elif isinstance(source, ForceInput):
                yield f"inputs.{name}", "force", source
        for name, sensor in self.sensors.items():
            if sensor is not None:
                yield f"sensors.{name}", sensor.kind, sensor
        for name, body in self.bodies.items():
            if body is not None and body.load is not None and body.load.pressure is not None:
                yield f"bodies.{name}.load.pressure", "pressure", body.load.pressure
        if self.speed is not None:
            yield "speed", "speed", self.speed
        for key, condition in self.running.items():
            if condition is not None:
                yield key, key, condition

    def _units(self) -> Iterator[str]:
        for key, quantity, address in self.addresses():
            try:
                address.conversion(SI[quantity])
            except UnitError as error:
                yield f"{key}.unit: {error}"
            if address.scale == 0:
                yield f"{key}.scale: 0 would make every value the same"
        unit = None if self.time is None else self.time.unit
        if unit is not None and known(unit, "s") not in FACTORS["s"]:
            yield f"time.unit: {unit!r} is no unit of time; known are s, ms, us, ns, min, h, d"
        if self.time is not None and self.time.rate is not None and self.time.column is not None:
            yield "time.rate: a table with a time column has its rate from there; give column or rate"


def _missing(name: str, names: Collection[str], key: str, what: str) -> Iterator[str]:
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        yield f"{key}: {name!r} is not {what}{hint}"
