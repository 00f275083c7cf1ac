"""Replicas of Ray Serve are added while requests wait for them, and taken away after that."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.system import load_system
from sprung.service.api import ray_serving
from sprung.service.api.ray_serving import APPLICATION, COMPUTE
from sprung.service.fleet.message import SentWindows
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.settings import Settings
from sprung.service.store import open_store
from tests.ray_apart import in_own_process

pytest.importorskip("ray.serve")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own
FIRST = 1_790_000_000_000_000_000  # ns
SIZES = ServingSizes(replicas=2, cores=0.5, more_after_seconds=1.0, fewer_after_seconds=3.0)


def running() -> int:
    """Replicas that compute."""
    from ray import serve

    found: dict[Any, int] = serve.status().applications[APPLICATION].deployments[COMPUTE].replica_states
    return int(found.get("RUNNING", 0))


def becomes(fulfilled: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not fulfilled():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.2)
    return True


def test_replicas_come_with_the_load_and_go_with_it(tmp_path: Path) -> None:
    in_own_process(come_and_go, tmp_path)


def come_and_go(folder: Path) -> None:
    from ray import serve

    system = load_system()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    settings = Settings(data_dir=folder, store=f"sqlite:///{folder}/sprung.db", port=port)
    open_store(settings.store_url).close()
    head = ray_serving.start(settings, SIZES, None, 2)
    handle: Any = serve.get_deployment_handle(COMPUTE, APPLICATION)
    try:
        assert running() == 1
        windows = 0.01 * np.random.default_rng(1).normal(size=(32, system.window, len(system.channels)))
        sent, nothing = [SentWindows("v-1", [FIRST + i * 10**9 for i in range(32)], windows)], [()]

        def ask() -> (
            Any
        ):  # the same windows again and again: they are identified, and known or waiting when they are folded
            return handle.take.remote(sent, nothing)

        def done(waiting: Any) -> bool:
            [taken] = waiting.result(timeout_s=120)
            return bool(taken.folded + taken.waiting + taken.known == 32)

        waiting = [ask() for _ in range(4)]
        count = len(waiting)
        while running() < 2 and count < 400:
            assert all(map(done, waiting))
            waiting = [ask() for _ in range(8)]
            count += 8
        assert all(map(done, waiting))
        assert running() == 2
        assert becomes(lambda: running() == 1, 60.0)
    finally:
        handle.shutdown()  # its thread outlives Ray and would start another one
        ray_serving.stop(head)
