"""Which CAN database a system's recordings and buses are decoded with; the one rule of all commands and of Python."""

from __future__ import annotations

from pathlib import Path

from sprung.model.system import MANCHESTER, MANCHESTER_DBC, System, load_system


def database_of(system: System, named: Path | None = None) -> Path | None:
    """The database that the user names; else the bundled one, where it is that of all CAN signals of the system.

    A system file that began as the bundled one (`diagnose --write-system`) thus needs no `--dbc`.  None: there is none.
    """
    if named is not None:
        return named
    ours = {channel.can for channel in system.channels if channel.can is not None}
    if not ours:
        return None
    bundled = {channel.can for channel in load_system(MANCHESTER).channels}
    return MANCHESTER_DBC if ours <= bundled else None
