"""What a month of a vehicle costs: every parameter at once, as the page asks for it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import insert

from sprung.model.system import System
from sprung.service.api.history import _rounded
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store.schema import rollups
from sprung.service.store.windows import pack
from sprung.service.times import NANOSECONDS
from tests.service_fakes import make_window

DAYS = 30
END = 1_790_000_000 // 3600 * 3600
MOST_SECONDS = 0.3  # of processor time, for 30 days of 24 parameters


@pytest.fixture
def core(engine: Engine, system: System, data_dir: Path) -> Core:
    """A vehicle with minutes and hours of thirty days, as they are left when single windows are forgotten."""
    built = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    built.pipeline.process("a", [make_window(system, i) for i in range(3)])
    size = len(system.tracked)
    rng = np.random.default_rng(3)
    rows = []
    for level in (60, 3600):
        for bucket in range(END - DAYS * 86_400, END, level):
            mean, std = pack(rng.normal(0.0, 0.01, size)), pack(np.full(size, 0.01))
            rows.append(
                {
                    "vehicle_id": "a",
                    "model_id": built.pipeline.model_id,
                    "resolution_s": level,
                    "bucket_ns": bucket * NANOSECONDS,
                    "windows": level,
                    "mean": mean,
                    "std": std,
                    "low": mean,
                    "high": mean,
                    "updated_ns": bucket * NANOSECONDS,
                }
            )
    with built.store.write() as connection:
        connection.execute(insert(rollups), rows)
    return built


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core)) as running:
        yield running


def test_thirty_days_of_every_parameter_cost_little(client: TestClient, system: System) -> None:
    names = [parameter.name for parameter in system.tracked]
    asked = {"parameter": names, "format": "columns", "since": str(END - DAYS * 86_400), "until": str(END)}
    client.get("/vehicles/a/history", params=asked)  # what is loaded at first use is not the history's
    begun = time.process_time()
    answer = client.get("/vehicles/a/history", params=asked)
    took = time.process_time() - begun
    found = answer.json()
    assert len(found["parameters"]) == 24 and 700 <= len(found["time"]) <= 2000
    assert found["time"][0] == 1000 * (END - DAYS * 86_400)
    assert all(None not in column["value"] for column in found["parameters"].values())
    assert took <= MOST_SECONDS, took


def test_rounding_keeps_seven_digits() -> None:
    values = np.array([1.23456789e6, -9.87654321e-5, 0.0, 1e9, 123456789.0, 5.0])
    rounded = _rounded(values, np.array([True] * 5 + [False]))
    assert rounded == [1234568.0, -9.876543e-05, 0.0, 1e9, 123456800.0, None]
