"""`sprung backup` and `sprung restore`."""

from __future__ import annotations

import sys
from pathlib import Path

from sprung.model.text import counted
from sprung.service.backup import Restored, back_up
from sprung.service.backup import restore as put_back
from sprung.service.cli.apart import readable
from sprung.service.settings import settings_with


def run(target: Path, data_dir: Path | None, store: str | None) -> int:
    """Back the data folder up."""
    made = back_up(settings_with({"data_dir": data_dir, "store": store}), target)
    print(f"{target}: {counted(len(made.files), 'file')}, {made.bytes / 1e6:.1f} MB, as of {made.created}")
    return 0


def restore(source: Path, keep_tokens: bool, data_dir: Path | None, store: str | None) -> int:
    """Put a back-up into a data folder, and say what has become of its tokens."""
    readable(source)
    settings = settings_with({"data_dir": data_dir, "store": store})
    restored = put_back(settings, source, keep_tokens)
    found = restored.backup
    print(f"{settings.data_dir}: {counted(len(found.files), 'file')} as of {found.created}, of Sprung {found.version}")
    if restored.tokens:
        print(_said_of_tokens(restored, keep_tokens), file=sys.stderr)
    return 0


def _said_of_tokens(restored: Restored, kept: bool) -> str:
    names = ", ".join(f"{row.id} ({row.name})" for row in restored.tokens)
    of = f"good when this was backed up ({restored.backup.created})"
    if kept:
        return (
            f"sprung: warning: tokens {of} are good again, also those that were revoked or rotated since; "
            f"revoke these with sprung token revoke ID: {names}"
        )
    return (
        f"sprung: warning: tokens {of} are revoked, as they may have been since; make new ones with "
        f"sprung token create, or restore with --keep-tokens: {names}"
    )
