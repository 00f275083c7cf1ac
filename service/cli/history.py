"""`sprung export`: histories out of a store, as CSV, Parquet or MCAP."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

from sprung.model.text import counted
from sprung.replay.whole_file import written_whole
from sprung.service.cli.options import time_of
from sprung.service.cli.targets import check_file
from sprung.service.errors import UserError
from sprung.service.export.tables import MEDIA_TYPES, history_file
from sprung.service.monitoring.engine import Engine, load_engine
from sprung.service.settings import Settings, settings_with
from sprung.service.store import fleet, history, open_store
from sprung.service.store.archive import open_archive

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
FOREVER = 2**63 - 1


def run(
    vehicle: str,
    *,
    system: Path | None,
    weights: Path | None,
    store: str | None,
    out: Path | None,
    kind: str | None,
    parameters: list[str],
    since: str | None,
    until: str | None,
    resolution: str,
) -> int:
    """Write the history of a vehicle's parameters to a file, or to standard output."""
    kind = kind or ("csv" if out is None else out.suffix.removeprefix("."))
    if kind not in MEDIA_TYPES:
        raise UserError(f"--format {kind}: known are {', '.join(MEDIA_TYPES)}")
    check_file(out)
    settings = settings_with({"system": system, "store": store, "weights": weights})
    engine = load_engine(settings)
    known = [p.name for p in engine.system.parameters]
    for name in parameters:
        if name not in known:
            raise UserError(f"--parameter {name}: {engine.system.name} has {', '.join(known[:3])}, ...")
    between = time_of("--since", since, 0), time_of("--until", until, FOREVER)
    found = _series(settings, engine, vehicle, between, _seconds(resolution))
    body = history_file(engine, vehicle, parameters or known, found, kind)
    if out is None:
        sys.stdout.buffer.write(body)
        sys.stdout.buffer.flush()
    else:
        with written_whole(out) as part:
            part.write_bytes(body)
        print(
            f"{out}: {counted(len(found.time), 'point')} of {counted(len(parameters or known), 'parameter')}",
            file=sys.stderr,
        )
    return 0


def _series(
    settings: Settings, engine: Engine, vehicle: str, between: tuple[int, int], resolution: float
) -> history.Series:
    """The history of a vehicle in a store, ns from and to, and in its archive; resolution: s, 0 for single windows."""
    with closing(open_store(settings.store_url, there=True)) as store, store.read() as connection:
        if not fleet.vehicle_exists(connection, vehicle):
            raise UserError(f"{settings.store_url}: nothing is known of vehicle {vehicle!r}")
        model = fleet.known_model(connection, engine.digest, engine.description())
        if model is None:
            raise UserError(f"{settings.store_url}: nothing was stored with this system")
        older = history.older_windows(open_archive(settings.archive), vehicle, fleet.digest_of(connection, model))
        return history.series(connection, vehicle, model, *between, resolution, FOREVER, older)


def _seconds(text: str) -> float:
    if text == "raw":
        return 0.0
    unit = UNITS.get(text[-1:])
    try:
        return float(text if unit is None else text[:-1]) * (unit or 1.0)
    except ValueError:
        raise UserError(f"--resolution {text}: give seconds, as in 60, 1m, 6h, or raw") from None
