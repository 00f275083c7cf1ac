"""What `sprung fleet serve` imports before Ray starts."""

from __future__ import annotations

import subprocess
import sys


def test_ray_is_started_before_anything_imports_torch() -> None:
    code = "import sys, sprung.service.cli.fleet_serve; print({'torch', 'scipy', 'fastapi'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
