"""How long work waits is measured in every queue."""

from __future__ import annotations

import time

from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.core import Core
from tests.service_fakes import make_window


def test_every_queue_shows_how_long_work_waits(core: Core, client: TestClient, system: System) -> None:
    core.pipeline.process("a", [make_window(system, 0)])
    assert client.get("/vehicles").status_code == 200
    job = core.jobs.submit("diagnosis", None, "a")
    deadline = time.monotonic() + 20
    while client.get(f"/jobs/{job.id}").json()["state"] in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    text = client.get("/metrics").text
    for queue in ("threads", "numerics", "store", "diagnosis jobs"):
        (line,) = [
            line for line in text.splitlines() if line.startswith(f'sprung_wait_seconds_count{{queue="{queue}"}}')
        ]
        assert float(line.split()[-1]) >= 1
    assert 'sprung_job_duration_seconds_count{kind="diagnosis",state="failed"} 1.0' in text
