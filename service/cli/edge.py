"""`sprung edge`."""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sprung.model.text import counted
from sprung.replay import UnreadableRecording
from sprung.replay.bus import parse_bus
from sprung.replay.live import LiveBus
from sprung.service.cli import apart
from sprung.service.cli.apart import readable
from sprung.service.cli.start_time import start_time
from sprung.service.errors import UserError
from sprung.service.fleet.nats_broker import NatsLink
from sprung.service.fleet.onboard import Onboard, OnboardCounts, OnboardSettings
from sprung.service.fleet.sending import HttpLink, Link, LinksByKind, Sending
from sprung.service.fleet.spool import Spool
from sprung.service.monitoring.engine import Engine, load_engine
from sprung.service.observability.logs import set_up
from sprung.service.settings import Settings, settings_with
from sprung.service.sources.feed import vehicle_of
from sprung.service.sources.live import LiveFeed
from sprung.service.sources.reading import ReadRequest

log = logging.getLogger("sprung.edge")
LAST_SECONDS = 20.0  # to send remaining messages at the end


@dataclass(frozen=True, slots=True)
class Destination:
    """Destination of messages from the vehicle."""

    server: str  # http(s)://, or nats:// for estimates only
    recordings: str | None  # raw samples; None: to the server, too
    token: str | None

    @property
    def broker(self) -> bool:
        """Whether estimates go to a broker."""
        return self.server.startswith("nats://")

    def link(self, vehicle: str) -> Link:
        """The way there.  Raises UserError for an address that is none."""
        link: Link = NatsLink(self.server, vehicle) if self.broker else HttpLink(self.server, self.token, vehicle)
        if self.recordings is None:
            return link
        return LinksByKind(link, HttpLink(self.recordings, self.token, vehicle, "--recordings"))


@dataclass(frozen=True, slots=True)
class EdgeRequest:
    """What `sprung edge` is asked to do."""

    settings: dict[str, Any]  # of the service, that replace those of the environment
    files: list[Path]  # recordings, or
    bus: str | None  # the bus to follow
    destination: Destination
    vehicle: str | None  # what it is called; None: as its first file or the bus
    spool: Path | None  # file of messages that wait; None: in the data folder
    spool_bytes: int
    speed: float  # of recordings, times real time; 0: no pause
    start: str | None  # when the recording began, if its times count from 0
    rates: OnboardSettings


def run(request: EdgeRequest, json_lines: bool) -> int:
    """Identify on board and send, until the files end or it is stopped."""
    _check(request)
    began = start_time(request.start, request.files)
    settings = settings_with(request.settings)
    set_up(settings.log_format, settings.log_level)
    engine = load_engine(settings)
    name = vehicle_of(request.vehicle, None, request.files[0].name if request.files else (request.bus or ""))
    started, cpu = time.perf_counter(), time.process_time()
    with ExitStack() as stack:
        spool = Spool(request.spool or settings.data_dir / "edge.db", request.spool_bytes)
        stack.callback(spool.close)
        link = request.destination.link(name)
        stack.callback(link.close)
        sending = Sending(spool, link)
        onboard = Onboard(engine, name, spool, _rates(request))
        sending.start()
        stack.callback(sending.stop)  # whatever ends it: the spool is closed next
        if request.files:
            _from_files(onboard, engine, request.files, name, request.speed, began, sending)
        else:
            _from_bus(onboard, engine, request.bus or "", name, settings)
        onboard.flush()
        empty = sending.close(LAST_SECONDS)
    seconds = onboard.counts.windows * engine.system.hop / engine.system.sample_rate
    took = time.perf_counter() - started, time.process_time() - cpu
    summary = _summary(name, onboard.counts, sending, spool_left(sending, empty), seconds, took)
    print(json.dumps({"edge": summary}) if json_lines else _line(summary), flush=True)
    return 0 if empty and not sending.refused and not onboard.counts.made_room else 1


def _check(request: EdgeRequest) -> None:
    if bool(request.files) == (request.bus is not None):
        raise UserError("give recordings or --can, one of both")
    for path in request.files:
        readable(path)


def _rates(request: EdgeRequest) -> OnboardSettings:
    """What is sent how often; a broker takes estimates only."""
    if request.destination.broker and request.destination.recordings is None:
        return replace(request.rates, raw_seconds=0.0)
    return request.rates


def _summary(
    name: str, counts: OnboardCounts, sending: Sending, waiting: str, seconds: float, took: tuple[float, float]
) -> dict[str, Any]:
    """What became of the windows; seconds: of recording; took: seconds of the wall clock, and of the processor."""
    wall, cpu = took
    return {
        "vehicle": name,
        "windows": counts.windows,
        "alarms": counts.alarms,
        "messages": counts.messages,
        "recordings": counts.raw_files,
        "sent": sending.sent,
        "refused": sending.refused,
        "given_up": counts.made_room,
        "waiting": waiting,
        "estimate_bytes_per_second": round(counts.message_bytes / seconds, 1) if seconds else None,
        "raw_bytes": counts.raw_bytes,
        "cpu_share": round(cpu / seconds, 4) if seconds else None,
        "wall_seconds": round(wall, 1),
    }


def spool_left(sending: Sending, empty: bool) -> str:
    """Why something waits still; empty where nothing does."""
    return "" if empty else sending.trouble or "the server takes its time"


def _line(summary: dict[str, Any]) -> str:
    left = f"; some wait in the spool: {summary['waiting']}" if summary["waiting"] else ""
    made = summary["messages"] + summary["recordings"]
    return (
        f"{summary['vehicle']}: {counted(summary['windows'], 'window')}, {summary['sent']} of {made} messages sent, "
        f"{summary['estimate_bytes_per_second'] or 0:.0f} B/s of estimates, "
        f"{summary['raw_bytes'] / 1e3:.0f} kB of raw samples, {100 * (summary['cpu_share'] or 0):.1f} % of a core{left}"
    )


def _from_files(
    onboard: Onboard,
    engine: Engine,
    files: list[Path],
    name: str,
    speed: float,
    start: int | None,
    sending: Sending,
) -> None:
    for path in files:
        reading = apart.reading(ReadRequest(path, engine.system, engine.dbc, 32, speed, start))
        for piece in reading.pieces(lambda: None):
            onboard.process(name, piece.windows)
            sending.wake()
        for problem in reading.ending.problems:
            print(f"sprung: {path}: {problem}", file=sys.stderr)


def _from_bus(onboard: Onboard, engine: Engine, bus: str, name: str, settings: Settings) -> None:
    """Follow a bus until SIGINT or SIGTERM."""
    if engine.dbc is None:
        raise UserError(f"--can {bus}: a CAN bus needs a CAN database; name it with --dbc")
    try:
        address = parse_bus(bus)
        stopping = threading.Event()
        source = LiveBus(
            address.interface, address.channel, engine.system.channels, engine.dbc, stop=stopping, **address.options
        )
    except UnreadableRecording as error:
        raise UserError(f"--can: {error}") from None
    feed = LiveFeed(onboard, source, name, stopping, lambda tally: None)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    feed.start()
    print(f"sprung edge: {name} on {bus}; Ctrl-C stops", flush=True)
    while not stopping.wait(1.0):
        pass
    feed.join(settings.shutdown_seconds)
