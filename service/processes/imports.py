"""Importing much at once, and what is imported for nothing."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType


@contextmanager
def lasting_imports() -> Iterator[None]:
    """Import without looking for garbage meanwhile, nor later among what was made: it lasts as long as the process.

    Measured with torch and the service: a sixth of the processor time.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collecting:
            gc.enable()


class _PythonCanAlone:
    """Refuses asammdf to python-can, and to nobody else."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        """Asked for every module that is imported."""
        if name == "asammdf":
            asking = sys.modules.get("can.io.mf4")
            if asking is not None and not hasattr(asking, "MF4Reader"):  # it is just being imported, and asks whether
                raise ModuleNotFoundError("python-can reads no MDF files here", name=name)


def python_can_alone() -> None:
    """In a process of Sprung's own: let python-can do without asammdf.

    It imports that, where it is installed, for readers of its own that nothing here uses: with pandas and a second of
    processor time, in every process that reads a recording.
    """
    if not any(isinstance(one, _PythonCanAlone) for one in sys.meta_path):
        sys.meta_path.insert(0, _PythonCanAlone())
