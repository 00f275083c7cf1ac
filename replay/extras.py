"""Libraries that only some formats need."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from sprung.replay.account import UnreadableRecording


def needed(library: str, extra: str, path: Path) -> None:
    """Raise UnreadableRecording, with what to install, when a library is not there."""
    if find_spec(library) is None:
        raise UnreadableRecording(f"{path}: reading {path.suffix} files needs {library}; pip install 'sprung[{extra}]'")
