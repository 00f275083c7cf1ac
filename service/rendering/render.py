"""Templates, and how numbers are written in them."""

from __future__ import annotations

import hashlib
import math
import re
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from sprung.service.monitoring.words import size_in_words, spoken
from sprung.service.times import to_iso

signed_in: ContextVar[str] = ContextVar("signed_in", default="")  # whose session the request is of
STATIC = Path(__file__).parent / "static"
LITERAL = re.compile(r"`([^`]*)`")
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("sprung.service.rendering"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"quantity": quantity, "percent": percent, "code": code, "moment": moment, "spoken": spoken}
    environment.filters["state"] = state
    environment.globals["with_std"] = with_std
    environment.globals |= {"asset": asset, "signed_in": signed_in.get, "size_in_words": size_in_words}
    return environment


def render(template: str, **values: Any) -> str:
    """A page from a template of this package."""
    return _environment().get_template(template).render(**values)


@cache
def asset(name: str) -> str:
    """The URL of a static file, with a part that changes with its content: it may be kept for ever."""
    digest = hashlib.sha256((STATIC / name).read_bytes()).hexdigest()[:12]
    return f"/static/{name}?v={digest}"


def code(text: str) -> Markup:
    """Plain text with its `literals` set as code."""
    return Markup(LITERAL.sub(r"<code>\1</code>", str(escape(text))))  # nosec B704: escaped first


def moment(nanoseconds: int) -> Markup:
    """`2026-09-21 14:13:20`: UTC, to the second; the machine's form beside it."""
    iso = to_iso(nanoseconds)
    return Markup('<time datetime="{}">{} {}</time>').format(iso, iso[:10], iso[11:19])


def quantity(value: float, unit: str) -> str:
    """`1.201 MN/m`: four digits and the prefix that fits; kilograms keep theirs."""
    factor, scaled = _scaled(value, unit)
    return f"{value / factor:.4g} {scaled}"


def _scaled(value: float, unit: str) -> tuple[float, str]:
    """The factor that fits a value, and the unit with its prefix."""
    fitting = ((factor, f"{prefix}{unit}") for factor, prefix in PREFIXES if abs(value) >= factor and unit != "kg")
    return next(fitting, (1.0, unit))


def with_std(value: float, std: float, unit: str) -> tuple[str, str]:
    """A value and its deviation as people write them, `("1.233", "± 0.014 MN/m")`: one unit, two digits of the
    deviation, and none of the value beyond those; `quantity` of the value where the deviation is none."""
    if not (math.isfinite(value) and 0 < std < math.inf):
        return quantity(value, unit), ""
    factor, scaled = _scaled(value, unit)
    digits = max(0, 1 - math.floor(math.log10(std / factor)))
    return f"{value / factor:.{digits}f}", f"± {std / factor:.{digits}f} {scaled}"


def state(name: str) -> str:
    """A state of a parameter or a sensor in one word of people: `good`, never `ok` here and `good` there."""
    return {"ok": "good", "absent": "no signal"}.get(name, name.replace("_", " "))


def percent(share: float | None, digits: int = 1) -> str:
    """`+2.3 %`; a dash where there is nothing to say."""
    if share is None or not math.isfinite(share):
        return "–"
    return f"{100 * share:+z.{digits}f} %"
