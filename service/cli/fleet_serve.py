"""`sprung fleet serve`: apart from the other commands, so that Ray starts before anything imports torch."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import closing
from typing import Any

from sprung.service.access.notice import access_notice, announce_access
from sprung.service.access.tokens import Tokens
from sprung.service.api import ray_serving
from sprung.service.api.listening import scheme
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.settings import settings_with
from sprung.service.store import open_store


def run_serve(options: dict[str, Any], sizes: ServingSizes, address: str | None, workers: int | None) -> int:
    """Serve until stopped."""
    settings = settings_with(options)
    with closing(open_store(settings.store_url)) as store:  # migrated once, before replicas start
        notice = access_notice(settings, Tokens(store).any)
    head = ray_serving.start(settings, sizes, address, workers)
    if notice:
        announce_access(notice)
    place = f"{scheme(settings)}://{settings.host}:{settings.port}"
    print(f"Sprung takes windows and estimates on {place}; Ctrl-C stops", flush=True)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    if ray_serving.watch(stopping, settings, head):
        ray_serving.stop(head)
        return 0
    print("sprung: Ray Serve does not answer any more; start this command again", file=sys.stderr, flush=True)
    ray_serving.abandon(head)
    os._exit(1)  # Ray's threads wait for a head that is gone
