"""A deciding number in a frozen value: with its reason, and the range over which it is varied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, Self


def rule(value: Any, reason: str, low: Any, high: Any) -> Any:
    """A deciding number with its reason, and the range over which `sprung bench sensitivity` varies it."""
    return field(default=value, metadata={"reason": reason, "range": (low, high)})


def reason_of(stage: str, number: Field[Any], varied: Mapping[str, Any]) -> str:
    """Reason for a number's value, and what other values changed when it was varied, as a benchmark wrote it."""
    found = varied["numbers"].get(f"{stage}.{number.name}")
    low, high = number.metadata["range"]
    if found is None or found["varied"] != [number.default, low, high]:
        return f"{number.metadata['reason']}; not varied as it is now"
    where = "; ".join(found.get("on", [f"{found['recordings']} of {found.get('of', varied['set'])}"]))
    effect = f"insensitive from {low:g} to {high:g}"
    if found["changes"]:
        effect = f"changes {'; '.join(found['changes'])}"
    return f"{number.metadata['reason']}; on {where} {effect}"


@dataclass(frozen=True)
class RuleTable:
    """Stages with their deciding numbers."""

    def constants(self) -> Iterator[tuple[str, Field[Any]]]:
        """Every number as the stage's name and its field."""
        for stage in fields(self):
            for one in fields(getattr(self, stage.name)):
                yield stage.name, one

    def varied(self, stage: str, name: str, value: Any) -> Self:
        """The same with one number changed."""
        return replace(self, **{stage: replace(getattr(self, stage), **{name: value})})
