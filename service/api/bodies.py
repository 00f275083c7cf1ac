"""What clients send: strict models, so that a wrong body is refused and never repaired in silence."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from sprung.model.signals import FloatArray
from sprung.service.api.problems import Problem
from sprung.service.engine import Engine
from sprung.service.times import from_iso

VehicleId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,127}$")]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
RATE_TOLERANCE = 1e-3  # relative; a clock that is off by more would shift stiffnesses by more than their bound


class Strict(BaseModel):
    """No coercion, no unknown keys."""

    model_config = ConfigDict(strict=True, extra="forbid")


class WindowBody(Strict):
    """One window: the same number of samples of every channel, SI units."""

    vehicle: VehicleId | None = None
    sample_rate: Annotated[Number, Field(gt=0, description="Hz; the system file's")]
    channels: dict[str, list[Number]] = Field(
        description="samples by channel; a sensor may be missing, an input may not"
    )
    start: str | None = Field(
        default=None, max_length=40, description="time of the first sample, RFC 3339; used with ?track=true"
    )


class DiagnoseBody(Strict):
    """What to look into: a recording that was uploaded before, or a vehicle's last minute."""

    recording: str | None = Field(default=None, max_length=36)
    vehicle: VehicleId | None = None


def window_values(body: WindowBody, engine: Engine) -> FloatArray:
    """The body as values of shape (T, C), NaN for absent sensors.

    Raises a 422 Problem that names the field: unknown channel, missing input, wrong length, wrong rate.
    """
    system = engine.system
    wrong: list[dict[str, str]] = []
    if abs(body.sample_rate / system.sample_rate - 1) > RATE_TOLERANCE:
        wrong.append(
            _wrong("sample_rate", f"is {body.sample_rate:g} Hz, {system.name} needs {system.sample_rate:g} Hz")
        )
    names = {channel.name: i for i, channel in enumerate(system.channels)}
    for name, samples in body.channels.items():
        if name not in names:
            wrong.append(_wrong(f"channels.{name[:160]}", f"is no channel of {system.name}"))
        elif len(samples) != system.window:
            wrong.append(_wrong(f"channels.{name}", f"has {len(samples)} samples, a window has {system.window}"))
    wrong += [
        _wrong(f"channels.{channel.name}", "is missing; without every input nothing can be identified")
        for channel in system.inputs
        if channel.name not in body.channels
    ]
    if not any(sensor in body.channels for sensor in system.sensors):
        wrong.append(_wrong("channels", "hold no sensor; without any nothing can be identified"))
    if wrong:
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        raise Problem(422, f"{wrong[0]['field']} {wrong[0]['detail']}{more}", wrong[:20])
    values = np.full((system.window, len(names)), np.nan)
    for name, samples in body.channels.items():
        values[:, names[name]] = samples
    return values


def start_of(body: WindowBody) -> int | None:
    """The window's start, ns since epoch, or None where the body has none; a 422 Problem when it is no time."""
    if body.start is None:
        return None
    try:
        start = from_iso(body.start)
    except ValueError:
        start = -1
    if not 0 <= start < 2**63:
        raise Problem(422, "start is no RFC 3339 time", [_wrong("start", "is no RFC 3339 time")])
    return start


def _wrong(field: str, detail: str) -> dict[str, str]:
    return {"field": field, "detail": detail}
