"""`sprung backup` and `sprung restore`."""

from __future__ import annotations

from pathlib import Path

from sprung.model.text import counted
from sprung.service.backup import back_up
from sprung.service.backup import restore as put_back
from sprung.service.cli.apart import readable
from sprung.service.settings import settings_with


def run(target: Path, data_dir: Path | None, store: str | None) -> int:
    """Back the data folder up."""
    made = back_up(settings_with({"data_dir": data_dir, "store": store}), target)
    print(f"{target}: {counted(len(made.files), 'file')}, {made.bytes / 1e6:.1f} MB, as of {made.created}")
    return 0


def restore(source: Path, data_dir: Path | None, store: str | None) -> int:
    """Put a back-up into a data folder."""
    readable(source)
    settings = settings_with({"data_dir": data_dir, "store": store})
    found = put_back(settings, source)
    print(f"{settings.data_dir}: {counted(len(found.files), 'file')} as of {found.created}, of Sprung {found.version}")
    return 0
