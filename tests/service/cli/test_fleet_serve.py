"""What `sprung fleet serve` imports where."""

from __future__ import annotations

import subprocess
import sys


def imported(modules: str) -> set[str]:
    """What of the slow packages a process has that imports these."""
    code = f"import sys, {modules}; print(*{{'cantools', 'fastapi', 'scipy', 'torch'}} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_ray_is_started_before_anything_imports_torch() -> None:
    assert imported("sprung.service.cli.fleet_serve") == set()


def test_the_door_of_ray_serve_has_no_model() -> None:
    assert imported("sprung.service.api.live_ingest, sprung.service.fleet.ray_behind") == {"fastapi"}
