"""What clients send: strict models, so that a wrong body is refused and never repaired in silence."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError
from pydantic_core import from_json

from sprung.model.signals import FloatArray
from sprung.service.api.problems import SHOWN_ERRORS, ApiProblem, from_validation
from sprung.service.engine import Engine
from sprung.service.times import NANOSECONDS, from_iso, to_iso

VehicleId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,127}$")]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
LARGEST = 1e12  # of a sample, in SI units
MOST_CHANNELS = 1000
MOST_KEYS = 20  # beside the channels
FUTURE_SECONDS = 300  # by which a client's clock may be ahead
RATE_TOLERANCE = 1e-3  # relative; a clock that is off by more would shift stiffnesses by more than their bound


class StrictBody(BaseModel):
    """No coercion, no unknown keys."""

    model_config = ConfigDict(strict=True, extra="forbid")


class WindowBody(StrictBody):
    """One window: the same number of samples of every channel, SI units."""

    vehicle: VehicleId | None = None
    sample_rate: Annotated[Number, Field(gt=0, description="Hz; the system file's")]
    channels: dict[str, list[Number]] = Field(
        description="samples by channel; a sensor may be missing, an input may not"
    )
    start: str | None = Field(
        default=None,
        max_length=40,
        description="time of the first sample, RFC 3339 or seconds since 1970; used with ?track=true",
    )


class DiagnoseBody(StrictBody):
    """What to look into: a recording that was uploaded before, or a vehicle's last minute."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": [name], "properties": {name: {"type": "string"}}, "not": {"required": [other]}}
                for name, other in (("recording", "vehicle"), ("vehicle", "recording"))
            ]
        }
    )

    recording: str | None = Field(default=None, max_length=36)
    vehicle: VehicleId | None = None


class WindowHead(StrictBody):
    """A window's body without its samples, which are looked at by themselves."""

    vehicle: VehicleId | None = None
    sample_rate: Annotated[Number, Field(gt=0)]
    start: str | None = Field(default=None, max_length=40)


def read_window(content: bytes, engine: Engine) -> tuple[WindowHead, FloatArray]:
    """The head of a `WindowBody` and its samples, shape (T, C), NaN for absent sensors.

    Costs milliseconds for any body within the limit, right or wrong: the first errors are told, then it stops.
    Raises a 422 ApiProblem that names the fields: unknown channel, missing input, wrong length, wrong rate, no number.
    """
    # counted before they are made into anything
    if max(content.count(mark) for mark in (b'"', b"[", b"{")) > 4 * MOST_CHANNELS:
        detail = "holds too many strings or lists: a window has a list of plain numbers a channel"
        raise ApiProblem(422, f"body {detail}", [_wrong("body", detail)])
    try:
        raw = from_json(content, allow_inf_nan=False)
    except ValueError as error:
        raise ApiProblem(422, f"body: {error}", [_wrong("body", str(error))]) from None
    if not isinstance(raw, dict):
        raise ApiProblem(422, "body: should be an object", [_wrong("body", "should be an object")])
    channels = raw.pop("channels", None)
    wrong: list[dict[str, str]] = []
    head = _head(raw, wrong)
    system = engine.system
    if head is not None and abs(head.sample_rate / system.sample_rate - 1) > RATE_TOLERANCE:
        detail = f"is {head.sample_rate:g} Hz, {system.name} needs {system.sample_rate:g} Hz"
        wrong.append(_wrong("sample_rate", detail))
    values = _samples(channels, engine, wrong)
    if wrong or head is None:
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        raise ApiProblem(422, f"{wrong[0]['field']} {wrong[0]['detail']}{more}", wrong[:SHOWN_ERRORS])
    return head, values


def _head(raw: dict[str, object], wrong: list[dict[str, str]]) -> WindowHead | None:
    if len(raw) > MOST_KEYS:
        wrong.append(_wrong("body", f"has {len(raw) + 1} keys; a window has four"))
        return None
    try:
        return WindowHead.model_validate(raw)
    except ValidationError as error:
        wrong += [dict(fault) for fault in from_validation(error).errors]
        return None


def _samples(channels: object, engine: Engine, wrong: list[dict[str, str]]) -> FloatArray:
    """Samples of all channels, shape (T, C); adds to `wrong`, at most a few more than are shown."""
    system = engine.system
    values = np.full((system.window, len(system.channels)), np.nan)
    if not isinstance(channels, dict):
        wrong.append(_wrong("channels", "should be an object of samples by channel"))
        return values
    if len(channels) > MOST_CHANNELS:
        wrong.append(_wrong("channels", f"are {len(channels)}; more than {MOST_CHANNELS} are not looked at"))
        return values
    names = {channel.name: i for i, channel in enumerate(system.channels)}
    for name, samples in channels.items():
        if len(wrong) >= SHOWN_ERRORS:
            return values
        if name not in names:
            wrong.append(_wrong(f"channels.{name[:160]}", f"is no channel of {system.name}"))
        elif fault := _not_numbers(samples, system.window):
            wrong.append(_wrong(f"channels.{name}{fault[0]}", fault[1]))
        else:
            values[:, names[name]] = samples
    wrong += [
        _wrong(f"channels.{channel.name}", "is missing; without every input nothing can be identified")
        for channel in system.inputs
        if channel.name not in channels
    ][:SHOWN_ERRORS]
    if not any(sensor in channels for sensor in system.sensors):
        wrong.append(_wrong("channels", "hold no sensor; without any nothing can be identified"))
    return values


def _not_numbers(samples: object, length: int) -> tuple[str, str] | None:
    """Place and fault of samples that are no list of `length` finite numbers; None where they are."""
    if not isinstance(samples, list):
        return "", "should be a list of numbers"
    if len(samples) != length:
        return "", f"has {len(samples)} samples, a window has {length}"
    for index, value in enumerate(samples):
        if type(value) not in (float, int):
            return f".{index}", "should be a number"
        if not abs(value) <= LARGEST:
            return f".{index}", f"should be a finite number within +-{LARGEST:g}"
    return None


def start_of(head: WindowHead, now: int) -> int | None:
    """The window's start, ns since epoch, or None where the body has none.

    A 422 ApiProblem when it is no time, or one that is still to come: the vehicle's tracker would take nothing that
    comes before it any more.
    """
    if head.start is None:
        return None
    try:
        start = from_iso(head.start)
    except ValueError:
        start = -1
    if not 0 <= start < 2**63:
        raise ApiProblem(422, "start is no RFC 3339 time", [_wrong("start", "is no RFC 3339 time")])
    if start > now + FUTURE_SECONDS * NANOSECONDS:
        detail = f"is more than {FUTURE_SECONDS // 60} minutes after {to_iso(now)}, the service's time"
        raise ApiProblem(422, f"start {detail}", [_wrong("start", detail)])
    return start


def _wrong(field: str, detail: str) -> dict[str, str]:
    return {"field": field, "detail": detail}
