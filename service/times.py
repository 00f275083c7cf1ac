"""Times as users read them: RFC 3339 in UTC, milliseconds; inside, int64 nanoseconds since the Unix epoch."""

from __future__ import annotations

import time
from datetime import UTC, datetime

NANOSECONDS = 1_000_000_000
FIRST_TIME = 946_684_800 * NANOSECONDS  # 2000: before it no clock of a vehicle was right
AHEAD = 300 * NANOSECONDS  # ns that a vehicle's clock may be ahead of this host's


def now_ns() -> int:
    """The wall clock, ns since epoch; the one place of the service that reads it for stored rows."""
    return time.time_ns()


def to_iso(nanoseconds: int) -> str:
    """`2026-09-21T14:13:20.500Z`: rounded to the millisecond."""
    milliseconds = (nanoseconds + 500_000) // 1_000_000
    seconds, rest = divmod(milliseconds, 1000)
    return datetime.fromtimestamp(seconds, tz=UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest:03d}Z"


def optional_iso(nanoseconds: int | None) -> str | None:
    """`to_iso`, or None where nothing happened yet."""
    return None if nanoseconds is None else to_iso(nanoseconds)


def from_iso(text: str) -> int:
    """Nanoseconds since epoch of an RFC 3339 time, or of seconds since epoch.

    Raises ValueError when it is neither: RFC 3339 has a time of day and a zone, and guessing either is off by hours.
    """
    if not text.isascii() or "_" in text or text != text.strip():  # Python takes more for a number than anybody sends
        raise ValueError(f"{text!r} is no time")
    try:
        return round(float(text) * NANOSECONDS)
    except (ValueError, OverflowError):
        moment = datetime.fromisoformat(text)
    if moment.tzinfo is None or len(text) <= len("2026-09-21"):
        raise ValueError(f"{text!r} has no time zone")
    whole = moment.replace(microsecond=0)
    return int(whole.timestamp()) * NANOSECONDS + moment.microsecond * 1000
