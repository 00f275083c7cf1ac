"""What processes of Sprung's own import, and that nobody else's are touched."""

from __future__ import annotations

import subprocess
import sys

import pytest


def imported(code: str) -> set[str]:
    """What of some slow packages a process has that runs this."""
    slow = {"asammdf", "can", "matplotlib", "pandas", "scipy.signal", "scipy.stats"}
    code = f"import sys\n{code}\nprint(*{slow} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


ALONE = "from sprung.service.processes.imports import python_can_alone; python_can_alone(); python_can_alone()"


def test_a_service_imports_what_it_needs_to_start() -> None:
    assert imported(f"{ALONE}; import sprung.service.cli.serve, sprung.model.identification.identify") == {"can"}


def test_python_can_does_without_asammdf_and_we_do_not() -> None:
    pytest.importorskip("asammdf")
    assert imported(f"{ALONE}; import can") == {"can"}
    assert "asammdf" in imported(f"{ALONE}; import can, asammdf")


def test_python_can_is_as_it_was_where_the_process_is_not_ours() -> None:
    pytest.importorskip("asammdf")
    assert "asammdf" in imported("import sprung.replay.live")
