"""`sprung system FILE --export OUT`: the model for other programs, by the suffix of the path."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sprung.model.exchange.fmu import write_fmu
from sprung.model.exchange.modelica import write_modelica
from sprung.model.exchange.statespace import ExchangeError, state_space, write_mat, write_npz
from sprung.model.exchange.tables import without_curve, write_tables
from sprung.model.laws import ElementLaw, SensorLaw
from sprung.model.laws.in_place import is_linear
from sprung.model.laws.placed import PlacedLaw
from sprung.model.system import System
from sprung.model.systemfile import written
from sprung.replay.whole_file import written_whole

REACH = 0.05, 1.0  # m and m/s up to which tables go


def export(system: System, out: Path) -> list[Path]:
    """Write one model; a path without a suffix is a folder of force tables.  Errors: `ExchangeError`, OSError."""
    if not out.parent.is_dir():
        raise ExchangeError(f"{out}: there is no folder {out.parent} to write it to")
    if out.suffix and out.is_dir():
        raise ExchangeError(f"{out}: is a folder; a file is to be written")
    kind = out.suffix.lower()
    if not kind:
        return write_tables(out, system, *REACH)
    if kind not in _WRITERS:
        raise ExchangeError(f"{out}: no format is called {kind}; known are .mat .npz .mo .fmu .yaml, or a folder")
    with written_whole(out) as part:
        _WRITERS[kind](part, system)
    return [out]


def _write_system_file(out: Path, system: System) -> None:
    out.write_text(written(system.file), encoding="utf-8")


_WRITERS: dict[str, Callable[[Path, System], None]] = {
    ".mat": lambda out, system: write_mat(out, state_space(system)),
    ".npz": lambda out, system: write_npz(out, state_space(system)),
    ".mo": write_modelica,
    ".fmu": write_fmu,
    ".yaml": _write_system_file,
    ".yml": _write_system_file,
}


def left_out(system: System, out: Path) -> list[str]:
    """What of the system's laws a format cannot hold, `secondary_2r.coulomb_friction`: nothing may go in silence."""
    suffix = out.suffix.lower()
    if suffix in (".yaml", ".yml"):
        return []
    without = without_curve(system) if suffix == "" else []
    laws = [placed for placed in system.laws if not _held(placed, suffix) or set(placed.places) & set(without)]
    return [f"{placed.location}.{placed.law.name}" for placed in laws]


def _held(placed: PlacedLaw, suffix: str) -> bool:
    if suffix in (".mat", ".npz"):
        return is_linear(placed) and not isinstance(placed.law, SensorLaw)
    if suffix == "":  # curves of single elements
        return isinstance(placed.law, ElementLaw) and len(placed.places) == 1
    return not isinstance(placed.law, SensorLaw)
