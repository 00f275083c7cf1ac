"""`sprung edge` and `sprung fleet ...`: their options; each imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sprung.service.cli.help_text import PlainTyper
from sprung.service.cli.options import Dbc, Json, Start, StoreUrl, System, Weights, finite_speed, vehicle_name
from sprung.service.processes.threads import one_thread_each

Place = Annotated[str, typer.Argument(help="Folder of recordings, or an address such as s3://bucket/folder.")]
On = Annotated[str, typer.Option("--on", help="here, ray, or auto: Ray where it is installed.")]
Workers = Annotated[
    int | None, typer.Option("--workers", min=1, help="Cores of a Ray that is started for this; default: all.")
]

fleet = PlainTyper(help="Many vehicles, many recordings, many machines.", no_args_is_help=True)


def edge(
    server: Annotated[str, typer.Option("--server", metavar="URL", help="Where estimates go.")],
    files: Annotated[
        list[Path] | None, typer.Argument(help="Recordings, instead of a bus.", metavar="[FILE...]")
    ] = None,
    can: Annotated[str | None, typer.Option("--can", metavar="INTERFACE:CHANNEL", help="The bus to follow.")] = None,
    recordings: Annotated[
        str | None,
        typer.Option("--recordings", metavar="URL", help="Where raw samples go, if not there: the pages' address."),
    ] = None,
    token: Annotated[
        str | None, typer.Option("--token", envvar="SPRUNG_TOKEN", help="With scope ingest; better in SPRUNG_TOKEN.")
    ] = None,
    vehicle: Annotated[
        str | None,
        typer.Option("--vehicle", metavar="NAME", help="What this vehicle is called.", callback=vehicle_name),
    ] = None,
    spool: Annotated[
        Path | None, typer.Option("--spool", metavar="FILE", help="What waits to be sent; default: in the data folder.")
    ] = None,
    spool_bytes: Annotated[
        int, typer.Option("--spool-bytes", min=1_000_000, help="Beyond, the oldest is given up.")
    ] = 200_000_000,
    message_seconds: Annotated[
        float, typer.Option("--message-seconds", min=1, help="Of windows in one message.")
    ] = 60.0,
    weigh_seconds: Annotated[
        float, typer.Option("--weigh-seconds", min=1, help="Between windows with evidence on gains, delays and loads.")
    ] = 30.0,
    raw_seconds: Annotated[
        float, typer.Option("--raw-seconds", min=0, help="Of raw samples around an alarm; 0: none.")
    ] = 60.0,
    speed: Annotated[
        float,
        typer.Option(
            "--speed",
            metavar="FACTOR",
            min=0,
            help="Of recordings, times real time; 0: no pause.",
            callback=finite_speed,
        ),
    ] = 0.0,
    start: Start = None,
    system: System = None,
    dbc: Dbc = None,
    weights: Weights = None,
    json_lines: Json = False,
) -> int:
    """On board: identify, send estimates, keep what cannot be sent.

    Estimates with covariance go to a service's POST /ingest/estimates, raw samples around alarms to POST /recordings,
    which Ray's ingest and a broker do not take: there, --recordings names the server of the pages, and without it no
    raw samples are kept for a broker.
    """
    one_thread_each()
    from sprung.service.cli.edge import Destination, EdgeRequest, run
    from sprung.service.fleet.onboard import OnboardSettings

    rates = OnboardSettings(message_seconds=message_seconds, weigh_seconds=weigh_seconds, raw_seconds=raw_seconds)
    options: dict[str, Any] = {"system": system, "dbc": dbc, "weights": weights}
    destination = Destination(server, recordings, token)
    request = EdgeRequest(options, files or [], can, destination, vehicle, spool, spool_bytes, speed, start, rates)
    return run(request, json_lines)


@fleet.command("backfill")
def backfill(
    place: Place,
    since: Annotated[
        str | None, typer.Option("--since", metavar="TIME", help="RFC 3339; windows before are left.")
    ] = None,
    until: Annotated[
        str | None, typer.Option("--until", metavar="TIME", help="RFC 3339; windows from then are.")
    ] = None,
    on: On = "auto",
    workers: Workers = None,
    store: StoreUrl = None,
    system: System = None,
    dbc: Dbc = None,
    weights: Weights = None,
    json_lines: Json = False,
) -> int:
    """Compute the history of many recordings anew.

    In parallel; it replaces the existing one.  Restarted, it continues where it stopped.  Unreadable files are
    reported at the end.
    """
    one_thread_each()
    from sprung.service.cli.fleet import run_backfill

    options: dict[str, Any] = {"system": system, "dbc": dbc, "weights": weights, "store": store}
    return run_backfill(options, place, since, until, on, workers, json_lines)


@fleet.command("diagnose")
def diagnose(
    place: Place,
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="A folder of its own for every report.")],
    on: On = "auto",
    workers: Workers = None,
    system: System = None,
    dbc: Dbc = None,
    json_lines: Json = False,
) -> int:
    """Diagnose many recordings, in parallel.

    Exit status 1 when one is not consistent or cannot be read.
    """
    one_thread_each()
    from sprung.service.cli.fleet import run_diagnose

    return run_diagnose({"system": system, "dbc": dbc}, place, out, on, workers, json_lines)


@fleet.command("serve")
def serve(
    store: StoreUrl = None,
    host: Annotated[str, typer.Option("--host", metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", metavar="NUMBER", min=1, max=65535)] = 8100,
    ray_address: Annotated[
        str | None, typer.Option("--ray", envvar="RAY_ADDRESS", help="A running cluster; default: a Ray started here.")
    ] = None,
    workers: Workers = None,
    replicas: Annotated[int, typer.Option("--replicas", min=1, help="That identify and track, at most.")] = 8,
    least: Annotated[int, typer.Option("--least", min=1, help="Of these; with 2, one that dies is not missed.")] = 1,
    cores: Annotated[float, typer.Option("--cores", min=0.1, help="Of a replica.")] = 0.8,
    system: System = None,
    weights: Weights = None,
) -> int:
    """Take estimates and windows in, on Ray Serve.

    POST /ingest/estimates and /ingest/windows, identified in batches, folded into one store.
    """
    one_thread_each()
    from sprung.service.cli.fleet_serve import run_serve
    from sprung.service.fleet.serving_sizes import ServingSizes

    options = {"system": system, "weights": weights, "store": store, "host": host, "port": port}
    return run_serve(options, ServingSizes(replicas=replicas, least=least, cores=cores), ray_address, workers)


@fleet.command("consume")
def consume(
    broker: Annotated[str, typer.Argument(help="nats://HOST:PORT or kafka://HOST:PORT/TOPIC.")],
    alive: Annotated[
        Path | None, typer.Option("--alive", metavar="FILE", help="Touched every second or so: a probe looks at it.")
    ] = None,
    store: StoreUrl = None,
    system: System = None,
    weights: Weights = None,
) -> int:
    """Store the messages of a broker.

    They are acknowledged once they are stored; several may do so on one PostgreSQL store.
    """
    one_thread_each()
    from sprung.service.cli.fleet import run_consume

    return run_consume({"system": system, "weights": weights, "store": store}, broker, alive)


@fleet.command("migrate")
def migrate(store: StoreUrl = None) -> int:
    """Bring the store's tables to this version.

    Makes the partitions of this month and the next, then ends.
    """
    from sprung.service.cli.fleet import run_migrate

    return run_migrate(store)


@fleet.command("demo")
def demo(
    vehicles: Annotated[int, typer.Option("--vehicles", min=1, max=50)] = 3,
    port: Annotated[int, typer.Option("--port", metavar="NUMBER", min=1, max=65000, help="Of the pages.")] = 8000,
) -> int:
    """Run the fleet variant on this machine.

    PostgreSQL, Ray Serve, pages, and vehicles that replay a recording.
    """
    from sprung.service.cli.fleet_demo import run

    return run(vehicles, port)
