"""`sprung doctor`: what of an installation works, and what to do about the rest."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any, Literal

import can
from packaging.requirements import Requirement

from sprung import __version__
from sprung.model.identification.identify import Identifier, load_identifier, without_weights
from sprung.model.system import load_system
from sprung.model.text import counted
from sprung.replay.bus import not_only_listened_to, opening_options, parse_bus
from sprung.replay.candecode import CanDecoder
from sprung.service.can_database import database_of
from sprung.service.settings import Settings, settings_with
from sprung.service.store import open_store
from sprung.service.store.status import StatusFilter, health_counts

BUS_SECONDS = 3.0
LOW_BYTES = 1_000_000_000
OLDEST = 1_767_225_600  # 2026-01-01: a clock before it has not been set


@dataclass(frozen=True, slots=True)
class Check:
    """The outcome of one check."""

    state: Literal["ok", "warning", "failed"]
    what: str
    text: str


def run(options: dict[str, Any], buses: list[str]) -> int:
    """Print a line for every check; 1 when one of them failed.  options: of the service, as for `sprung serve`."""
    settings = settings_with(options)
    failed = False
    for check in (_installation, _model, _database, _store, _disk, _clock):
        for finding in _guarded(check, settings):
            failed |= finding.state == "failed"
            print(f"{finding.state:8s} {finding.what}: {finding.text}", flush=True)
    for name in buses:
        finding = _bus(name)
        failed |= finding.state == "failed"
        print(f"{finding.state:8s} {finding.what}: {finding.text}", flush=True)
    return int(failed)


def _guarded(check: Callable[[Settings], Iterator[Check]], settings: Settings) -> Iterator[Check]:
    try:
        yield from check(settings)
    except (ValueError, OSError) as error:
        yield Check("failed", check.__name__.strip("_"), " ".join(str(error).split()))


def _installation(_settings: Settings) -> Iterator[Check]:
    yield Check("ok", "installation", f"sprung {__version__}, Python {sys.version.split()[0]}")
    try:
        needed = [Requirement(line) for line in requires("sprung") or []]
    except PackageNotFoundError:
        yield Check("warning", "packages", "sprung runs from a source tree; its packages are not checked")
        return
    wrong = []
    for need in needed:
        if need.marker is not None and not need.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(need.name)
        except PackageNotFoundError:
            wrong.append(f"{need.name} is missing")
            continue
        if not need.specifier.contains(found, prereleases=True):
            wrong.append(f"{need.name} {found} is not {need.specifier}")
    if wrong:
        yield Check("failed", "packages", "; ".join(wrong) + "; install sprung anew")
    else:
        yield Check("ok", "packages", "as required")


def _model(settings: Settings) -> Iterator[Check]:
    system = load_system(settings.system) if settings.system is not None else load_system()
    identifier = load_identifier(system, settings.weights)
    parameters = counted(len(system.parameters), "parameter")
    unused = without_weights(system) if settings.weights is not None else ""
    if unused:
        yield Check("warning", "model", f"{parameters}; the weights {settings.weights} are not used: {unused}")
    elif not isinstance(identifier, Identifier) or identifier.estimator is None:
        text = f"{system.name}, {parameters}; no trained estimator: identified from the nominal values, which is slower"
        yield Check("warning", "model", text)
    else:
        yield Check("ok", "model", f"{system.name}, {parameters}, with a trained estimator")


def _database(settings: Settings) -> Iterator[Check]:
    system = load_system(settings.system) if settings.system is not None else load_system()
    signals = sum(channel.can is not None for channel in system.channels)
    database = database_of(system, settings.dbc)
    if database is not None:
        CanDecoder((*system.channels, *system.auxiliary), database)
        yield Check("ok", "database", f"{database} has the {counted(signals, 'CAN signal')} of {system.name}")
    elif signals:
        yield Check("warning", "database", f"{system.name} has {counted(signals, 'CAN signal')}; name one with --dbc")
    else:
        yield Check("ok", "database", f"none is needed: {system.name} has no CAN signals")


def _store(settings: Settings) -> Iterator[Check]:
    store = open_store(settings.store_url)
    try:
        with store.read() as connection:
            vehicles = sum(health_counts(connection, StatusFilter()).values())
            if connection.dialect.name == "sqlite":
                said = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one()
                if said != "ok":
                    yield Check("failed", "store", f"{settings.store_url} is damaged: {said}; restore a back-up")
                    return
        with store.write():
            pass
    finally:
        store.close()
    yield Check("ok", "store", f"{settings.store_url}, {counted(vehicles, 'vehicle')}, can be written")


def _disk(settings: Settings) -> Iterator[Check]:
    folder = settings.data_dir
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    state: Literal["ok", "warning"] = "ok" if free > LOW_BYTES else "warning"
    yield Check(state, "disk", f"{free / 1e9:.1f} GB free at {folder}")


def _clock(_settings: Settings) -> Iterator[Check]:
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    if time.time() < OLDEST:
        yield Check("failed", "clock", f"it is {now} by this machine: set its clock")
        return
    tool = shutil.which("timedatectl")
    said = ""
    if tool is not None:
        command = [tool, "show", "--property=NTPSynchronized", "--value"]
        said = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5).stdout.strip()
    if said == "yes":
        yield Check("ok", "clock", f"{now}, synchronised")
    elif said == "no":
        yield Check("warning", "clock", f"{now}, not synchronised: windows of live buses carry this machine's time")
    else:
        yield Check("ok", "clock", f"{now}; its synchronisation cannot be checked here")


def _bus(name: str) -> Check:
    """Open a bus as the service would, and listen for a moment."""
    try:
        address = parse_bus(name)
        options = opening_options(address, ids=None)
        with can.Bus(interface=address.interface, channel=address.channel, **options) as bus:
            end = time.monotonic() + BUS_SECONDS
            count = 0
            while time.monotonic() < end:
                count += bus.recv(0.1) is not None
    except Exception as error:  # every driver raises its own
        return Check("failed", f"bus {name}", " ".join(str(error).split()) or type(error).__name__)
    if not count:
        return Check("warning", f"bus {name}", f"open, but silent for {BUS_SECONDS:g} s; check cable and bit rate")
    rate = f"{count / BUS_SECONDS:.0f} frames a second"
    if advice := not_only_listened_to(address):
        return Check("warning", f"bus {name}", f"{rate}; {advice}")
    return Check("ok", f"bus {name}", rate)
