"""`sprung serve`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from sprung.replay.candatabase import load_database
from sprung.service.cli.apart import readable
from sprung.service.cli.console import print_table, width_of_output
from sprung.service.cli.parameters import parameter_table
from sprung.service.cli.progress import plain_progress
from sprung.service.cli.replay import closing_line, health, incomplete_line
from sprung.service.cli.start_time import start_time
from sprung.service.cli.targets import check_folder
from sprung.service.core import Core
from sprung.service.main import Feeds, serve
from sprung.service.monitoring.views import vehicle_view
from sprung.service.observability.logs import set_up
from sprung.service.settings import settings_with
from sprung.service.sources.feed import FeedResult, OnBatch


def run(
    options: dict[str, Any],
    files: list[Path],
    speed: float,
    buses: list[str],
    vehicle: str | None,
    start: str | None = None,
) -> int:
    """Serve until stopped."""
    began = start_time(start, files)
    for path in files:
        readable(path)
    settings = settings_with(options)
    if settings.dbc is not None:  # rather than with the first recording
        load_database(settings.dbc)
    set_up(settings.log_format, settings.log_level)
    check_folder(settings.data_dir)  # before the model is loaded, which takes seconds

    def announce(address: str) -> None:
        print(
            f"Sprung serves on {address} (pages), {address}/docs (API), {address}/metrics; "
            f"store {settings.store_url}; Ctrl-C stops",
            flush=True,
        )

    with suppress(KeyboardInterrupt):  # the usual way to stop
        serve(settings, Feeds(tuple(files), speed, tuple(buses), vehicle, began), watch, announce)
    return 0


def watch(path: Path, core: Core) -> tuple[OnBatch, Callable[[FeedResult], None]]:
    """Show a recording that is replayed into the service, then its table."""
    system = core.engine.system

    def on_end(fed: FeedResult) -> None:
        assert fed.state is not None
        view = vehicle_view(core.engine, fed.vehicle, fed.state, None)
        print_table(parameter_table(replace(view, health=health(view, fed)), width_of_output()))
        print(closing_line(view, fed, system.channels), flush=True)
        complaint = incomplete_line(path, fed)
        if complaint:
            print(f"sprung: {complaint}", file=sys.stderr, flush=True)

    return plain_progress(path.name, system.hop / system.sample_rate), on_end
