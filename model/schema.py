"""The system file: its format, and reading it with errors that name the key and the line.

A lumped mechanical system in YAML, SI units, x forward, y left, z up.  Format: docs/system-file.md.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator


class SystemFileError(ValueError):
    """The system file cannot be used; the message names the key, the line and what to do."""


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Value(Strict):
    """A physical value; `fixed` ones are never estimated."""

    value: float = Field(ge=0)
    fixed: bool = False


def _as_value(raw: Any) -> Any:
    return {"value": raw} if isinstance(raw, (int, float)) and not isinstance(raw, bool) else raw


Quantity = Annotated[Value, BeforeValidator(_as_value)]
Point = tuple[float, float]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class Address(Strict):
    """Where recordings keep one signal, and the standard deviation of one sample."""

    mcap: str | None = Field(default=None, pattern=r"^/.+\..+$")
    can: str | None = Field(default=None, pattern=r"^[^.]+\.[^.]+$")
    csv: str | None = None
    noise: float = Field(default=0.0, ge=0)


class Body(Strict):
    """A rigid body: heaves; with inertias it also rolls and pitches about `position`."""

    mass: Quantity  # kg
    roll_inertia: float | None = Field(default=None, gt=0)  # kg m^2
    pitch_inertia: float | None = Field(default=None, gt=0)  # kg m^2
    position: Point = (0.0, 0.0)  # m

    @model_validator(mode="after")
    def _has_mass(self) -> Body:
        if self.mass.value <= 0:
            raise ValueError("mass must be greater than 0")
        return self


class SupportInput(Strict):
    """A measured moving support."""

    kind: Literal["displacement"]
    displacement: Address  # m
    velocity: Address | None = None  # m/s


class ForceInput(Address):
    """A measured force on a body."""

    kind: Literal["force"]
    body: str
    position: Point | None = None


Input = Annotated[SupportInput | ForceInput, Field(discriminator="kind")]


class Element(Strict):
    """Spring and damper in parallel; deflection is upper minus lower."""

    upper: str
    lower: str
    position: Point | None = None
    stiffness: Quantity = Value(value=0.0, fixed=True)  # N/m
    damping: Quantity = Value(value=0.0, fixed=True)  # N s/m


class MotionSensor(Address):
    kind: Literal["acceleration", "velocity", "displacement"]
    body: str
    position: Point | None = None


class ElementSensor(Address):
    """Deflection (m) of an element, or the force (N) it carries, positive in extension."""

    kind: Literal["deflection", "force"]
    element: str


Sensor = Annotated[MotionSensor | ElementSensor, Field(discriminator="kind")]
EstimatedQuantity = Literal["stiffness", "damping", "mass"]


class SystemFile(Strict):
    """Everything a system file says, with references between its parts checked."""

    name: str = Field(min_length=1)
    sample_rate: float = Field(gt=0)  # Hz
    window: int = Field(ge=8)  # samples, the paper's tau
    hop: int | None = Field(default=None, ge=1)  # samples between window starts; default half a window
    bodies: dict[Name, Body] = Field(min_length=1)
    inputs: dict[Name, Input] = Field(default_factory=dict)
    elements: dict[Name, Element] = Field(default_factory=dict)
    sensors: dict[Name, Sensor] = Field(min_length=1)
    estimate: tuple[EstimatedQuantity, ...] = ("stiffness", "damping")

    @model_validator(mode="after")
    def _references_exist(self) -> SystemFile:
        ends = {*self.bodies, "ground", *(n for n, i in self.inputs.items() if i.kind == "displacement")}
        for name, element in self.elements.items():
            for side in ("upper", "lower"):
                _require(getattr(element, side), ends, f"elements.{name}.{side}", "a body, a support or ground")
            if element.upper == element.lower:
                raise ValueError(f"elements.{name}.lower: both ends are {element.upper!r}")
            if element.upper not in self.bodies and element.lower not in self.bodies:
                raise ValueError(f"elements.{name}.upper: neither end is a body, so the element moves nothing")
            for quantity in ("stiffness", "damping"):
                value = getattr(element, quantity)
                if quantity in self.estimate and not value.fixed and value.value == 0:
                    raise ValueError(
                        f"elements.{name}.{quantity}: a nominal value of 0 cannot be estimated; "
                        "give a rough positive value or {value: 0.0, fixed: true}"
                    )
        for name, source in self.inputs.items():
            if isinstance(source, ForceInput):
                _require(source.body, set(self.bodies), f"inputs.{name}.body", "a body")
        for name, sensor in self.sensors.items():
            if isinstance(sensor, MotionSensor):
                _require(sensor.body, set(self.bodies), f"sensors.{name}.body", "a body")
            else:
                _require(sensor.element, set(self.elements), f"sensors.{name}.element", "an element")
        if "ground" in self.bodies or "ground" in self.inputs:
            raise ValueError("bodies.ground: the name ground is reserved for the fixed support")
        for name in set(self.inputs) & set(self.sensors):
            raise ValueError(f"sensors.{name}: an input has this name already")
        if len(set(self.estimate)) != len(self.estimate):
            raise ValueError("estimate: a quantity is listed twice")
        if self.hop is not None and self.hop > self.window:
            raise ValueError(f"hop: {self.hop} samples is longer than the window of {self.window}")
        return self


def _require(name: str, known: set[str], key: str, what: str) -> None:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{key}: {name!r} is not {what}{hint}")


class _Loader(yaml.SafeLoader):
    """YAML 1.2 floats (1e-5 is a number) and no silently repeated keys."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)$"),
    list("-+0123456789."),
)


def _unique_mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key, _ in node.value:
        if key.value in seen:
            raise SystemFileError(f"line {key.start_mark.line + 1}: {key.value}: this key occurs twice")
        seen.add(key.value)
    return dict(loader.construct_pairs(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:map", _unique_mapping)


def read_system_file(path: str | Path) -> SystemFile:
    """Read and check a system file.

    Errors: `SystemFileError`, one line: file, line, key, what is wrong.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise SystemFileError(f"{path}: cannot read the system file: {reason}") from None
    return parse_system_file(text, str(path))


def parse_system_file(text: str, source: str = "system file") -> SystemFile:
    """Check the text of a system file; `source` names it in errors."""
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            raw = loader.construct_document(node) if node is not None else None
        finally:
            loader.dispose()
    except SystemFileError as error:
        raise SystemFileError(f"{source}: {error}") from None
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        problem = " ".join(str(error).split())
        raise SystemFileError(f"{source}: not YAML: {problem[:200]}") from None
    if not isinstance(raw, Mapping):
        raise SystemFileError(f"{source}: a mapping with name, bodies, elements, sensors is expected")
    try:
        return SystemFile.model_validate(raw)
    except ValidationError as error:
        raise SystemFileError(f"{source}: {_explain(error, node)}") from None


def _explain(error: ValidationError, node: yaml.Node | None) -> str:
    """The first problem as `line N: key: message`."""
    first = error.errors()[0]
    location = [str(part) for part in first["loc"]]
    message = first["msg"].removeprefix("Value error, ")
    keys = _existing_keys(node, location)
    if first["type"] == "value_error" and ":" in message and not location:
        key, message = message.split(": ", 1)
        location = key.split(".")
        keys = location
    if first["type"] == "model_type":
        message = "a number or a mapping is expected"
    elif first["type"] == "extra_forbidden":
        message = "unknown key"
    elif first["type"] == "missing":
        message = "this key is missing"
        keys = [*keys, str(first["loc"][-1])]
    line = _line_of(node, keys)
    return f"line {line}: {'.'.join(keys)}: {message}"


def _existing_keys(node: yaml.Node | None, location: list[str]) -> list[str]:
    """Drop the parts of a pydantic location (union tags, validators) that are not keys of the file."""
    keys: list[str] = []
    for part in location:
        child = _child(node, part)
        if child is None:
            continue
        keys.append(part)
        node = child[1]
    return keys


def _child(node: yaml.Node | None, key: str) -> tuple[yaml.Node, yaml.Node] | None:
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == key:
                return name, value
    if isinstance(node, yaml.SequenceNode) and key.isdigit() and int(key) < len(node.value):
        return node.value[int(key)], node.value[int(key)]
    return None


def _line_of(node: yaml.Node | None, keys: list[str]) -> int:
    line = node.start_mark.line if node is not None else 0
    for key in keys:
        child = _child(node, key)
        if child is None:
            break
        line, node = child[0].start_mark.line, child[1]
    return line + 1
