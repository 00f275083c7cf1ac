"""`--start`: when a recording began whose times count from 0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sprung.service.errors import UserError
from sprung.service.times import from_iso


def start_time(text: str | None, files: Sequence[Path]) -> int | None:
    """Nanoseconds since 1970; raises UserError when it is no time, or when it cannot be that of several files."""
    if text is None:
        return None
    if len(files) != 1:
        raise UserError("--start says when one recording began; give one FILE with it")
    try:
        return from_iso(text)
    except (ValueError, OverflowError):
        raise UserError(
            f"--start {text!r}: a time with its zone is expected, such as 2026-09-21T14:13:20Z "
            "or 2026-09-21T16:13:20+02:00"
        ) from None
