"""Parts of a long benchmark that are done, kept in a folder, so that the same command goes on where it stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def kept(file: Path | None, settings: list[Any]) -> dict[str, Any] | None:
    """What was found for a part under these settings; None: nothing yet, or nothing is kept."""
    if file is None or not file.exists():
        return None
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found["told"] if found["settings"] == settings else None


def keep(file: Path | None, settings: list[Any], result: dict[str, Any]) -> None:
    """`told` of a part, whole or not at all: a run may end while it writes."""
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(".part")
        beside.write_text(json.dumps({"settings": settings, "told": result}), encoding="utf-8")
        beside.replace(file)
