"""A deciding number in a frozen value: with its reason, and the range over which it is varied."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def rule(value: Any, reason: str, low: Any, high: Any) -> Any:
    """A deciding number with its reason, and the range over which `sprung bench sensitivity` varies it."""
    return field(default=value, metadata={"reason": reason, "range": (low, high)})
