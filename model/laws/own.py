"""Laws of a user's own, from a Python file beside the system file (docs/catalogue.md shows one)."""

from __future__ import annotations

import runpy
from pathlib import Path

from sprung.model.laws.kinds import Law


class LawFileError(ValueError):
    """The file of laws cannot be used; the message gives the reason in one line."""


def load_laws(path: str | Path, known: tuple[str, ...] = ()) -> tuple[Law, ...]:
    """All laws that a Python file defines, in its order; `known` names are taken.

    The file is run: use only files that you trust.
    """
    try:
        names = runpy.run_path(str(path))
    except Exception as error:
        problem = " ".join(str(error).split()) or type(error).__name__
        raise LawFileError(f"{path}: cannot be read as laws: {type(error).__name__}: {problem}") from None
    found: list[Law] = []
    for value in names.values():
        if isinstance(value, Law) and value.name not in known:
            if value.name in [law.name for law in found]:
                raise LawFileError(f"{path}: two laws are called {value.name!r}; give each its own name")
            found.append(value)
    if not found:
        raise LawFileError(f"{path}: no law is defined here; see docs/catalogue.md for an example")
    return tuple(found)
