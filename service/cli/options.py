"""Options that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from sprung.service.errors import UserError
from sprung.service.times import from_iso

System = Annotated[
    Path | None, typer.Option("--system", metavar="FILE", help="System file; default: the Manchester vehicle.")
]
Dbc = Annotated[
    Path | None,
    typer.Option(
        "--dbc", metavar="FILE", help="CAN database; default: the bundled one, where it has the system's signals."
    ),
]
Start = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="TIME",
        help="When the recording began, if its times count from 0; default: the file's own time.",
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", metavar="FOLDER", help="Trained estimator; default: the bundled one."),
]
StoreUrl = Annotated[
    str | None,
    typer.Option("--store", metavar="URL", help="SQLAlchemy URL or SQLite file of the store; also SPRUNG_STORE."),
]
Json = Annotated[bool, typer.Option("--json", help="JSON lines on stdout, for machines.")]


def vehicle_name(name: str | None) -> str | None:
    """An option's name of a vehicle: other names would be made fit in silence, and two of them the same.

    Errors: `UserError`.
    """
    if name is None:
        return None
    from sprung.service.sources.feed import vehicle_of

    if name != (fit := vehicle_of(name, None, "vehicle")):
        raise UserError(f"--vehicle {name!r}: letters, digits and . _ : - only, at most 128; {fit!r} would do")
    return name


def finite_speed(factor: float) -> float:
    """An option's factor of real time.  Errors: `UserError`."""
    if math.isinf(factor):
        raise UserError("--speed: give 0 for as fast as possible")
    return factor


def time_of(option: str, text: str | None, default: int) -> int:
    """An option's time in nanoseconds.  Errors: `UserError`."""
    try:
        return default if text is None else from_iso(text)
    except (ValueError, OverflowError):
        raise UserError(f"{option} {text}: give an RFC 3339 time, as in 2026-09-21T14:13:20Z") from None
