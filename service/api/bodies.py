"""What clients send: strict models, so that a wrong body is refused and never repaired in silence."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from itertools import chain
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, WithJsonSchema
from pydantic_core import PydanticCustomError, from_json

from sprung.model.signals import FloatArray
from sprung.model.text import CONTROL, IN_VEHICLE_IDS, UNSEEN
from sprung.service.api.duplicate_keys import duplicate_keys
from sprung.service.api.problems import SHOWN_ERRORS, ApiProblem, from_validation
from sprung.service.fleet.message import SentWindows
from sprung.service.monitoring.form import WindowForm
from sprung.service.times import FIRST_TIME, NANOSECONDS, from_iso, to_iso

VEHICLE_ID = re.compile(rf"^[A-Za-z0-9][{IN_VEHICLE_IDS}]{{0,127}}$")


def _vehicle_id(text: str) -> str:
    if VEHICLE_ID.fullmatch(text) is None:  # people type it, too: no regular expression for them
        raise PydanticCustomError(
            "vehicle_id", "letters, digits and . _ : - only, at most 128, first a letter or digit"
        )
    return text


VehicleId = Annotated[
    str, AfterValidator(_vehicle_id), WithJsonSchema({"type": "string", "pattern": VEHICLE_ID.pattern})
]
_IN_LINES = f"{CONTROL}{UNSEEN}"
_IN_TEXTS = rf"\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f{UNSEEN}"  # lines and tabs are allowed


def _without(hidden: str, text: str) -> str:
    """The text, if it has no character of the class `hidden`: the first is named, as people type these texts and a
    regular expression tells them nothing."""
    if (found := re.search(f"[{hidden}]", text)) is None:
        return text
    said = "holds the hidden character {point} at place {place}; leave it out"
    raise PydanticCustomError("hidden_character", said, {"point": f"U+{ord(found[0]):04X}", "place": found.start() + 1})


LINE = (AfterValidator(partial(_without, _IN_LINES)), Field(json_schema_extra={"pattern": f"^[^{_IN_LINES}]*$"}))
TEXT = (AfterValidator(partial(_without, _IN_TEXTS)), Field(json_schema_extra={"pattern": f"^[^{_IN_TEXTS}]*$"}))
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
LARGEST = 1e12  # of a sample, in SI units
MOST_CHANNELS = 1000
MOST_WINDOWS = 30  # of one request
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
        description="samples by channel; one may be missing, and what it alone determines is then not identifiable"
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


def read_window(content: bytes, form: WindowForm) -> tuple[WindowHead, FloatArray]:
    """The head of a `WindowBody` and its samples, shape (T, C), NaN for absent channels.

    Costs milliseconds for any body within the limit, right or wrong: the first errors are told, then it stops.
    Raises a 422 ApiProblem that names the fields: unknown channel, missing inputs, wrong length, wrong rate, no number.
    """
    raw = _object(content)
    wrong: list[dict[str, str]] = []
    values = _samples(raw.pop("channels", None), form, wrong)
    head = _head(raw, form, wrong)
    if head is None or wrong:
        raise _refused(wrong)
    return head, values


def read_windows(content: bytes, form: WindowForm, now: int) -> SentWindows:
    """One window, as `read_window` takes it, or several of a vehicle: `windows`, each with `start` and `channels`.

    Vehicle and starts are needed.  now: ns since epoch.  Raises a 422 ApiProblem that names the fields.
    """
    raw = _object(content)
    several = raw.pop("windows", None)
    if several is None:
        several = [{key: raw.pop(key) for key in ("start", "channels") if key in raw}]
    wrong: list[dict[str, str]] = []
    head = _head(raw, form, wrong)
    if not isinstance(several, list) or not 0 < len(several) <= MOST_WINDOWS:
        wrong.append(_wrong("windows", f"should be a list of 1 to {MOST_WINDOWS} windows"))
        raise _refused(wrong)
    starts, values = [], []
    for i, one in enumerate(several):
        place = f"windows.{i}." if len(several) > 1 else ""
        if not isinstance(one, dict) or one.keys() != {"start", "channels"} or not isinstance(one["start"], str):
            wrong.append(_wrong(f"{place}start", "is needed beside channels, and nothing else"))
            break
        starts.append(_time(one["start"], now, place))
        values.append(_samples(one["channels"], form, wrong, place))
        if len(wrong) >= SHOWN_ERRORS:
            break
    if head is not None and head.vehicle is None:
        wrong.append(_wrong("vehicle", "is needed"))
    if head is None or head.vehicle is None or wrong:
        raise _refused(wrong)
    return SentWindows(head.vehicle, starts, np.stack(values))


def _object(content: bytes) -> dict[str, object]:
    """The body as an object of JSON."""
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
    # the parser keeps the last of two keys; each string has two quotation marks, and what was kept accounts for all
    if (b"\\" in content or content.count(b'"') != 2 * _strings(raw)) and (names := duplicate_keys(content)):
        raise _refused([_wrong(name[:160], "is there twice") for name in names])
    return raw


def _strings(thing: object) -> int:
    """Keys and strings in it, but for lists that begin with a number."""
    if isinstance(thing, dict):
        return len(thing) + sum(map(_strings, thing.values()))
    if isinstance(thing, list):
        return 0 if not thing or isinstance(thing[0], float | int) else sum(map(_strings, thing))
    return int(isinstance(thing, str))


def _refused(wrong: list[dict[str, str]]) -> ApiProblem:
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    return ApiProblem(422, f"{wrong[0]['field']} {wrong[0]['detail']}{more}", wrong[:SHOWN_ERRORS])


def _head(raw: dict[str, object], form: WindowForm, wrong: list[dict[str, str]]) -> WindowHead | None:
    """What stands beside the samples; adds to `wrong` where it is none, or of another rate."""
    if len(raw) > MOST_KEYS:
        wrong.append(_wrong("body", f"has {len(raw) + 1} keys; a window has four"))
        return None
    try:
        head = WindowHead.model_validate(raw)
    except ValidationError as error:
        wrong += [dict(fault) for fault in from_validation(error).errors]
        return None
    if abs(head.sample_rate / form.sample_rate - 1) > RATE_TOLERANCE:
        detail = f"is {head.sample_rate:g} Hz, {form.system} needs {form.sample_rate:g} Hz"
        wrong.append(_wrong("sample_rate", detail))
    return head


def _samples(channels: object, form: WindowForm, wrong: list[dict[str, str]], place: str = "") -> FloatArray:
    """Samples of all channels, shape (T, C); adds to `wrong`, at most a few more than are shown."""
    values = np.full((form.length, len(form.channels)), np.nan)
    if not isinstance(channels, dict):
        wrong.append(_wrong(f"{place}channels", "should be an object of samples by channel"))
        return values
    if len(channels) > MOST_CHANNELS:
        wrong.append(_wrong(f"{place}channels", f"are {len(channels)}; more than {MOST_CHANNELS} are not looked at"))
        return values
    names = {name: i for i, name in enumerate(form.channels)}
    together = _numbers(channels, form.length) if names.keys() >= channels.keys() else None
    if together is not None:
        values[:, [names[name] for name in channels]] = together
    else:
        wrong += _faults(channels, names, form, place)
        if len(wrong) >= SHOWN_ERRORS:
            return values
    for some in form.needed:
        if not some & channels.keys():
            first = next(name for name in form.inputs if name in some)
            others = f", and so are {len(some) - 1} like it" if len(some) > 1 else ""
            wrong.append(_wrong(f"{place}channels.{first}", f"is missing{others}; nothing can be identified without"))
    if not any(sensor in channels for sensor in form.sensors):
        wrong.append(_wrong(f"{place}channels", "hold no sensor; without any nothing can be identified"))
    return values


def _numbers(channels: dict[str, object], length: int) -> FloatArray | None:
    """`length` finite numbers of each channel, shape (T, channels); None where any is anything else."""
    lists = [samples for samples in channels.values() if isinstance(samples, list) and len(samples) == length]
    if not lists or len(lists) < len(channels):
        return None
    samples: list[object] = list(chain.from_iterable(lists))
    if not set(map(type, samples)) <= {float, int}:
        return None
    try:
        columns = np.array(samples, dtype=float).reshape(len(lists), length)
    except OverflowError:  # an integer beyond all floats
        return None
    return columns.T if columns.min() >= -LARGEST and columns.max() <= LARGEST else None


def _faults(
    channels: dict[str, object], names: Mapping[str, int], form: WindowForm, place: str
) -> list[dict[str, str]]:
    """What is wrong with samples by channel, of which something is; at most a few more than are shown."""
    wrong: list[dict[str, str]] = []
    for name, samples in channels.items():
        if len(wrong) >= SHOWN_ERRORS:
            break
        if name not in names:
            wrong.append(_wrong(f"{place}channels.{name[:160]}", f"is no channel of {form.system}"))
        elif _numbers({name: samples}, form.length) is None:
            at, fault = _not_numbers(samples, form.length)
            wrong.append(_wrong(f"{place}channels.{name}{at}", fault))
    return wrong


def _not_numbers(samples: object, length: int) -> tuple[str, str]:
    """Place and fault of samples that are no list of `length` finite numbers."""
    if not isinstance(samples, list):
        return "", "should be a list of numbers"
    if len(samples) != length:
        return "", f"has {len(samples)} samples, a window has {length}"
    number = next(i for i, value in enumerate(samples) if not _is_sample(value))
    if type(samples[number]) not in (float, int):
        return f".{number}", "should be a number"
    return f".{number}", f"should be a finite number within +-{LARGEST:g}"


def _is_sample(value: object) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and bool(abs(value) <= LARGEST)


def start_of(head: WindowHead, now: int) -> int | None:
    """The window's start, ns since epoch, or None where the body has none.

    A 422 ApiProblem when it is no time, or one that is still to come: the vehicle's tracker would take nothing that
    comes before it any more.
    """
    return None if head.start is None else _time(head.start, now)


def _time(text: str, now: int, place: str = "") -> int:
    try:
        start = from_iso(text)
    except ValueError:
        start = -1
    if not 0 <= start < 2**63:
        raise _refused([_wrong(f"{place}start", "is no RFC 3339 time")])
    if start < FIRST_TIME:
        raise _refused([_wrong(f"{place}start", "is before the year 2000: the clock was not set")])
    if start > now + FUTURE_SECONDS * NANOSECONDS:
        detail = f"is more than {FUTURE_SECONDS // 60} minutes after {to_iso(now)}, the service's time"
        raise _refused([_wrong(f"{place}start", detail)])
    return start


def _wrong(field: str, detail: str) -> dict[str, str]:
    return {"field": field, "detail": detail}
