"""The service: core, application, feeds and server, wired and run."""

from __future__ import annotations

import logging
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from math import inf
from pathlib import Path
from types import FrameType
from typing import NoReturn

import uvicorn

from sprung.replay.live import LiveBus
from sprung.service.api.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.engine import load_engine
from sprung.service.errors import UserError
from sprung.service.feed import Fed, OnBatch, feed_file, feed_live, vehicle_of
from sprung.service.recordings import file_row, finish_row
from sprung.service.settings import Settings
from sprung.service.store.work import add_recording
from sprung.service.worker import Limits

log = logging.getLogger("sprung")

Watch = Callable[[Path, Core], "tuple[OnBatch, Callable[[Fed], None]]"]


@dataclass(frozen=True, slots=True)
class Feeds:
    """What is fed into the service beside its API."""

    files: tuple[Path, ...] = ()
    speed: float = 0.0  # times real time; 0: as fast as possible
    buses: tuple[str, ...] = ()  # INTERFACE:CHANNEL
    vehicle: str | None = None


class Interrupted(Exception):
    """The service stops while a recording is fed."""


def serve(settings: Settings, feeds: Feeds, watch: Watch, announce: Callable[[str], None]) -> None:
    """Run until SIGINT or SIGTERM; what was accepted is stored before this returns.

    watch: callbacks that show a recording's progress and outcome; announce: told the address once it is open.
    Raises UserError for settings, files and buses that cannot be used.
    """
    engine = load_engine(settings)
    with ExitStack() as stack:
        listening = stack.enter_context(_listen(settings))
        core = build_core(settings, engine)
        stack.callback(core.close)
        buses = [_bus(core, name) for name in feeds.buses]
        threads = [threading.Thread(target=_feed_files, args=(core, feeds, watch), daemon=True)]
        threads += [threading.Thread(target=_feed_bus, args=(core, bus, feeds.vehicle), daemon=True) for bus in buses]

        def start() -> None:
            for thread in threads:
                thread.start()

        def stop() -> None:
            core.stopping.set()
            for thread in threads:
                thread.join()
            core.close()

        host, port = listening.getsockname()[:2]
        announce(f"http://{f'[{host}]' if ':' in host else host}:{port}")
        config = uvicorn.Config(
            create_app(core, start, stop),
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=settings.shutdown_seconds,
            timeout_keep_alive=30,
            lifespan="on",
        )
        # uvicorn raises the signal that stopped it again when it is done: for a service that is a good end
        stack.callback(signal.signal, signal.SIGTERM, signal.signal(signal.SIGTERM, _exit))
        uvicorn.Server(config).run(sockets=[listening])


def _exit(_number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(0)


def _listen(settings: Settings) -> socket.socket:
    """The socket, before anything else is started, so that a port in use is a plain error."""
    try:
        found = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = found[0]
        return socket.create_server(address[:2], family=family, backlog=1024)
    except OSError as error:
        detail = error.strerror or error
        raise UserError(f"cannot listen on {settings.host}:{settings.port}: {detail}; choose another --port") from error


def _bus(core: Core, name: str) -> LiveBus:
    interface, separator, channel = name.partition(":")
    if not separator or not interface or not channel:
        raise UserError(f"--can {name}: give INTERFACE:CHANNEL, as in socketcan:can0")
    if core.engine.dbc is None:
        raise UserError(f"--can {name}: a CAN bus needs a CAN database; name it with --dbc")
    return LiveBus(interface, channel, core.engine.system.channels, core.engine.dbc, stop=core.stopping)


def _feed_bus(core: Core, bus: LiveBus, vehicle: str | None) -> None:
    name = vehicle_of(vehicle, None, bus.name.replace("/", "_"))
    try:
        feed_live(core.pipeline, bus, name, core.stopping, core.tally_counter(bus.name))
    except Exception:
        log.exception("the feed of %s ended", bus.name)


def _feed_files(core: Core, feeds: Feeds, watch: Watch) -> None:
    def check() -> None:
        if core.stopping.is_set():
            raise Interrupted

    for path in feeds.files:
        on_batch, on_end = watch(path, core)
        try:
            row = file_row(path)
            with core.store.write() as connection:
                add_recording(connection, row)
            fed = feed_file(
                core.pipeline,
                path,
                vehicle=feeds.vehicle,
                recording_id=row.id,
                batch_windows=core.settings.batch_windows,
                speed=feeds.speed,
                limits=Limits(inf, inf, core.settings.worker_memory_bytes),
                on_batch=on_batch,
                on_tally=core.tally_counter("file"),
                check=check,
            )
            finish_row(core.store, row, fed)
            on_end(fed)
        except Interrupted:
            return
        except (ValueError, OSError) as error:
            log.error("%s", error)
        except Exception:
            log.exception("replay of %s failed", path)
