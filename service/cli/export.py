"""`sprung system FILE --export OUT`: the model for other programs, by the suffix of the path."""

from __future__ import annotations

from pathlib import Path

from sprung.model.exchange.fmu import write_fmu
from sprung.model.exchange.modelica import write_modelica
from sprung.model.exchange.statespace import ExchangeError, state_space, write_mat, write_npz
from sprung.model.exchange.tables import write_tables
from sprung.model.system import System

REACH = 0.05, 1.0  # m and m/s up to which tables go


def export(system: System, out: Path) -> list[Path]:
    """Write one model; a path without a suffix is a folder of force tables.  Errors: `ExchangeError`."""
    match out.suffix.lower():
        case ".mat":
            write_mat(out, state_space(system))
        case ".npz":
            write_npz(out, state_space(system))
        case ".mo":
            write_modelica(out, system)
        case ".fmu":
            write_fmu(out, system)
        case "":
            return write_tables(out, system, *REACH)
        case other:
            raise ExchangeError(f"{out}: no format is called {other}; known are .mat .npz .mo .fmu, or a folder")
    return [out]
