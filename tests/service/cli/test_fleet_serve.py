"""What `sprung fleet serve` imports where."""

from __future__ import annotations

import subprocess
import sys


def imported(modules: str) -> set[str]:
    """What of the slow packages a process has that imports these."""
    slow = {"alembic", "cantools", "fastapi", "scipy", "scipy.signal", "scipy.stats", "torch"}
    code = f"import sys, {modules}; print(*{slow} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_ray_is_started_before_anything_imports_torch() -> None:
    assert imported("sprung.service.cli.fleet_serve") == set()


def test_the_door_of_ray_serve_has_no_model() -> None:
    assert imported("sprung.service.api.live_ingest, sprung.service.fleet.ray_backend") == {"fastapi"}


def test_replicas_import_of_scipy_what_they_need() -> None:
    what = "sprung.service.fleet.ray_replicas, sprung.service.fleet.ingest, sprung.model.identification.identify"
    assert imported(what) == {"scipy", "torch"}
