"""The service: core, application, feeds and server, wired and run."""

from __future__ import annotations

import logging
import signal
import ssl
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from types import FrameType
from typing import NoReturn, TypeVar

from sprung.replay import UnreadableRecording
from sprung.replay.bus import parse_bus
from sprung.replay.live import LiveBus
from sprung.service.access.notice import access_notice, announce_access, is_loopback
from sprung.service.access.tokens import Tokens
from sprung.service.api.listening import listen, scheme
from sprung.service.api.server import make_server
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.errors import UserError
from sprung.service.jobs.recordings import add_row, file_row, finish_row, reading_limits
from sprung.service.lock import held
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.numerics import numerics
from sprung.service.observability.connections import ConnectionCollector
from sprung.service.processes.worker import ProcessLimits, WorkerKilled
from sprung.service.retrying import retry
from sprung.service.settings import Settings
from sprung.service.sources.feed import FeedResult, OnBatch, feed_file, vehicle_of
from sprung.service.sources.live import LiveFeed
from sprung.service.store import open_store

log = logging.getLogger("sprung")

T = TypeVar("T")
Watch = Callable[[Path, Core], "tuple[OnBatch, Callable[[FeedResult], None]]"]


@dataclass(frozen=True, slots=True)
class Feeds:
    """What is fed into the service beside its API."""

    files: tuple[Path, ...] = ()
    speed: float = 0.0  # times real time; 0: as fast as possible
    buses: tuple[str, ...] = ()  # INTERFACE:CHANNEL[,OPTION=VALUE...]
    vehicle: str | None = None
    start: int | None = None  # ns since 1970, when the file began, if its times count from 0


class Interrupted(Exception):
    """The service stops while a recording is fed."""


def serve(settings: Settings, feeds: Feeds, watch: Watch, announce: Callable[[str], None]) -> None:
    """Run until SIGINT or SIGTERM; what was accepted is stored before this returns.

    watch: callbacks that show a recording's progress and outcome; announce: called with the address once it is open.
    Raises UserError for settings, files and buses that cannot be used.
    """
    check_access(settings)
    loaded = load_engine(settings)
    with ExitStack() as stack:
        found = stack.enter_context(numerics(loaded, settings))
        stack.enter_context(held(settings.data_dir))
        listening = stack.enter_context(listen(settings))
        core = build_core(settings, found.engine, found.following, found.processes)
        stack.callback(core.close)
        notice = access_notice(settings, core.tokens.any or core.oidc is not None)
        add_live_feeds(core, feeds)
        files = threading.Thread(target=_feed_files, args=(core, feeds, watch), daemon=True)

        def start() -> None:
            files.start()
            for feed in core.feeds:
                feed.start()

        def stop() -> None:
            core.stop()
            files.join(settings.shutdown_seconds)
            for feed in core.feeds:
                feed.join(settings.shutdown_seconds)
            core.close()

        host, port = listening.getsockname()[:2]
        announce(f"{scheme(settings)}://{f'[{host}]' if ':' in host else host}:{port}")
        if notice:
            announce_access(notice)
        try:
            server = make_server(create_app(core, start, stop), settings, core.stop)
        except (OSError, ssl.SSLError) as error:
            raise UserError(f"TLS: {settings.tls_certificate}: {error.strerror or error}") from error
        door = server.doorkeeper
        core.metrics.registry.register(ConnectionCollector(lambda: len(door), lambda: door.closed))
        # uvicorn raises the signal that stopped it again when it is done: for a service that is a good end
        stack.callback(signal.signal, signal.SIGTERM, signal.signal(signal.SIGTERM, _exit))
        server.run(sockets=[listening])


def check_access(settings: Settings) -> None:
    """Before anything is loaded: raises UserError for a service that others reach and that asks for no token."""
    if settings.open or settings.admin_token is not None or settings.oidc_issuer or is_loopback(settings.host):
        return
    with held(settings.data_dir):  # opening may change the store: not while another service works on it
        store = open_store(settings.store_url)
        try:
            access_notice(settings, Tokens(store).any)
        finally:
            store.close()


def _exit(_number: int, _frame: FrameType | None) -> NoReturn:
    sys.exit(0)


def add_live_feeds(core: Core, feeds: Feeds) -> None:
    """Every bus, into the list that health, metrics and notifications look at.  Raises UserError."""
    core.feeds += [live_feed(core, text, feeds.vehicle) for text in feeds.buses]


def live_feed(core: Core, text: str, vehicle: str | None) -> LiveFeed:
    """The feed of a bus, as `--can` names it; raises UserError where there can be none."""
    try:
        address = parse_bus(text)
    except UnreadableRecording as error:
        raise UserError(f"--can: {error}") from None
    if core.engine.dbc is None:
        raise UserError(f"--can {text}: a CAN bus needs a CAN database; name it with --dbc")
    bus = LiveBus(
        address.interface,
        address.channel,
        (*core.engine.system.channels, *core.engine.system.auxiliary),
        core.engine.dbc,
        stop=core.stopping,
        **address.options,
    )
    name = vehicle_of(vehicle, None, bus.name.replace("/", "_"))
    return LiveFeed(core.pipeline, bus, name, core.stopping, core.tally_counter(bus.name))


def _limits(settings: Settings, path: Path, speed: float) -> ProcessLimits:
    """What reading a file that is replayed may use: as of an upload, but it may take as long as its ride did."""
    limits = reading_limits(settings, path)
    return replace(limits, seconds=inf, silence_seconds=inf if speed else limits.silence_seconds)


def _once_more(feed: Callable[[], T]) -> T:
    """Again, where the process that read the recording was ended: what is stored already is not stored twice."""
    try:
        return feed()
    except WorkerKilled as error:
        log.error("%s; it is tried once more", error)
        return feed()


def _feed_file(
    core: Core, feeds: Feeds, path: Path, recording_id: str, watch: Watch, check: Callable[[], None]
) -> tuple[FeedResult, Callable[[FeedResult], None]]:
    """What became of a file, and who is told at the end."""
    on_batch, on_end = watch(path, core)
    fed = feed_file(
        core.pipeline,
        path,
        vehicle=feeds.vehicle,
        recording_id=recording_id,
        batch_windows=core.settings.batch_windows,
        speed=feeds.speed,
        limits=_limits(core.settings, path, feeds.speed),
        start=feeds.start,
        on_batch=on_batch,
        on_tally=core.tally_counter("file"),
        check=check,
        retrying=True,
    )
    return fed, on_end


def _feed_files(core: Core, feeds: Feeds, watch: Watch) -> None:
    def check() -> None:
        if core.stopping.is_set():
            raise Interrupted

    for path in feeds.files:
        try:
            row = file_row(path, feeds.start)
            retry(partial(add_row, core.store, row), path.name, check)
            fed, on_end = _once_more(partial(_feed_file, core, feeds, path, row.id, watch, check))
            retry(partial(finish_row, core.store, row, fed), path.name, check)
            on_end(fed)
        except Interrupted:
            return
        except (ValueError, OSError) as error:
            log.error("%s", error)
        except Exception:
            log.exception("replay of %s failed", path)
