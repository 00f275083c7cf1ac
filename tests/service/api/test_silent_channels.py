"""Channels of which nothing comes, from the samples that are sent to what REST, metrics and the page say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.settings import Settings
from sprung.service.times import now_ns, to_iso
from tests.service_fakes import HOP

SILENT = ("wheel_11r.displacement", "wheel_11r.velocity")
WINDOWS = 14


@pytest.fixture
def client(system: System, data_dir: Path) -> Iterator[TestClient]:
    """Of a service that identifies in earnest."""
    core = build_core(Settings(data_dir=data_dir), Engine(system, Identifier(system), make_tracker(system)))
    with TestClient(create_app(core), raise_server_exceptions=False) as running:
        yield running


def test_a_vehicle_without_a_wheels_channels_is_monitored_and_says_what_is_silent(
    client: TestClient, system: System
) -> None:
    rng = np.random.default_rng(3)
    values = simulate_runs(system, np.zeros((WINDOWS, 24)), system.window, rng).values
    names = [channel.name for channel in system.channels]
    begin = now_ns() - WINDOWS * HOP
    for number, window in enumerate(values):
        channels = {n: window[:, i].tolist() for i, n in enumerate(names) if n not in SILENT}
        body = {"vehicle": "a", "sample_rate": 100.0, "start": to_iso(begin + number * HOP), "channels": channels}
        answer = client.post("/identify?track=true", json=body)
        assert answer.status_code == 200, answer.text
        known = {p["name"]: p["identifiable"] for p in answer.json()["parameters"]}
        assert not known["primary_11r.stiffness"] and known["primary_11l.stiffness"]
    vehicle = client.get("/vehicles/a").json()
    assert {(s["channel"], s["kind"]) for s in vehicle["sensors"]} == {(name, "silent") for name in SILENT}
    assert {(a["kind"], a["parameter"]) for a in vehicle["alarms"]} == {("sensor", f"{name}.silent") for name in SILENT}
    assert vehicle["health"] == "check_function"
    lost = {p["name"] for p in vehicle["parameters"] if p.get("lost_with") == "|".join(SILENT)}
    assert lost == {"primary_11r.stiffness", "primary_11r.damping"}
    metrics = client.get("/metrics").text
    for name in SILENT:
        assert f'sprung_sensor_fault{{channel="{name}",kind="silent",vehicle="a"}} 1.0' in metrics
    assert "No signal: " + ", ".join(SILENT) in client.get("/pages/vehicles/a").text
