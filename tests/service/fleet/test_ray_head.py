"""Ray's head dies and is started anew: actors that live answer all the while, and new ones are started."""

from __future__ import annotations

import os
import signal
import time
from importlib import import_module
from typing import Any

import pytest

from sprung.benchmarks.fleet_processes import descendants
from tests.ray_apart import in_own_process

pytest.importorskip("ray")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own


class Counter:
    """Counts in memory."""

    def __init__(self) -> None:
        self._count = 0

    def add(self) -> int:
        self._count += 1
        return self._count


def kill_and_start_anew() -> None:
    ray: Any = import_module("ray")  # its types know no actors of plain classes

    from sprung.service.fleet.ray_head import RayHead

    head = RayHead(1)
    try:
        actor = ray.remote(num_cpus=0)(Counter)
        lives = actor.options(name="counter").remote()
        assert ray.get(lives.add.remote()) == 1
        [pid] = [one.pid for one in descendants(os.getpid()) if "gcs_server" in one.command.split("\0")[0]]
        os.kill(pid, signal.SIGKILL)
        while head.lives():
            time.sleep(0.02)
        assert ray.get(lives.add.remote(), timeout=30) == 2
        assert head.start_anew() and head.lives()
        assert ray.get(ray.get_actor("counter").add.remote(), timeout=30) == 3
        assert ray.get(actor.remote().add.remote(), timeout=60) == 1
    finally:
        ray.shutdown()
        head.close()


def test_a_head_that_was_killed_goes_on_with_what_it_knew() -> None:
    in_own_process(kill_and_start_anew)
