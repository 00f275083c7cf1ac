"""The API against its own description, by schemathesis: no server error, no answer that is not described."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn

from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.service_fakes import make_window

ROOT = Path(__file__).resolve().parents[2]
TOOL = shutil.which("st", path=str(Path(sys.executable).parent))
TOKEN = "a-token-of-at-least-twenty-characters"
pytestmark = pytest.mark.skipif(TOOL is None, reason="schemathesis is not installed")


@pytest.fixture
def address(engine: Engine, system: System, data_dir: Path) -> Iterator[str]:
    """A service with a vehicle that is good and one that is alarmed; without a token nobody gets far."""
    core = build_core(Settings(data_dir=data_dir, admin_token=TOKEN), engine)  # type: ignore[arg-type]
    server = uvicorn.Server(uvicorn.Config(create_app(core), port=0, log_level="error", lifespan="on"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        thread.join(0.05)
    for vehicle, level in (("car-17", 0.3), ("car-18", 0.0)):
        core.pipeline.process(vehicle, [make_window(system, i) for i in range(80)])
        core.pipeline.process(vehicle, [make_window(system, 80 + i, level) for i in range(40)])
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(20)


def schemathesis(address: str, folder: Path, *options: str) -> str:
    assert TOOL is not None
    command = [TOOL, "--config-file", str(ROOT / "schemathesis.toml"), "run", f"{address}/openapi.json"]
    command += ["-H", f"Authorization: Bearer {TOKEN}", "--suppress-health-check", "all", "--continue-on-failure"]
    done = subprocess.run([*command, *options], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    return done.stdout


def test_the_examples_of_the_description_are_answered_as_described(address: str, tmp_path: Path) -> None:
    said = schemathesis(address, tmp_path, "--phases", "examples")
    assert re.search(r"Selected: (\d+)/\1\b", said), said


@pytest.mark.slow
def test_what_schemathesis_makes_up_is_answered_as_described(address: str, tmp_path: Path) -> None:
    said = schemathesis(address, tmp_path, "--max-time", "120", "-n", "8")
    for phase in ("Examples", "Coverage", "Fuzzing", "Stateful"):
        assert phase in said
