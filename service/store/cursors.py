"""Numbers in the cursors of pages: what a page before gave, and nothing that merely reads like it."""

from __future__ import annotations

import re

WHOLE = re.compile(r"-?[0-9]{1,19}")  # ASCII: int() would take digits of any script, and underscores between them
MOST = 2**63


def whole_number(text: str) -> int:
    """A 64-bit integer, as a store can compare it.  Raises ValueError."""
    number = int(text) if WHOLE.fullmatch(text) else MOST
    if not -MOST <= number < MOST:
        raise ValueError(f"{text[:40]!r} is no 64-bit integer")
    return number
