"""`sprung retention`."""

from __future__ import annotations

from pathlib import Path

from sprung.model.text import counted
from sprung.service.housekeeping import Housekeeping
from sprung.service.settings import settings_with
from sprung.service.store import open_store
from sprung.service.times import to_iso


def run(dry_run: bool, data_dir: Path | None, store: str | None) -> int:
    """Delete old data, or list what would be deleted."""
    settings = settings_with({"data_dir": data_dir, "store": store})
    opened = open_store(settings.store_url, there=True)
    try:
        housekeeping = Housekeeping(settings, opened)
        now = housekeeping.clock.read() if dry_run else housekeeping.clock.now()
        found = housekeeping.once(now, keep=not dry_run)
    finally:
        opened.close()
    would = "would be forgotten" if dry_run else "are forgotten"
    room = f" ({found.windows_for_room} of them to make room)" if found.windows_for_room else ""
    print(
        f"as of {to_iso(now)}: {counted(found.windows, 'window')}{room}, "
        f"{counted(found.minutes, 'one-minute roll-up')} and "
        f"{counted(len(found.upload_files), 'uploaded file')} {would}"
    )
    return 0
