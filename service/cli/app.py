"""The commands and their options; each imports what it needs when it runs, so that `--help` is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sprung import __version__
from sprung.service.cli import fleet_commands, store_commands
from sprung.service.cli.help_text import PlainTyper
from sprung.service.cli.options import Dbc, Json, Start, StoreUrl, System, Weights, finite_speed, vehicle_name
from sprung.service.processes.imports import lasting_imports
from sprung.service.processes.memory import check_address_space
from sprung.service.processes.threads import hand_over_often, one_thread_each

app = PlainTyper(
    name="sprung",
    help="Springs and dampers of rail vehicles, identified from running recordings.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its boxes call a flag <bool>, and break names on narrow terminals
    context_settings={"help_option_names": ["-h", "--help"]},
)

Files = Annotated[
    list[Path],
    typer.Argument(help="MCAP, BLF, ASC, candump .log, MF4, CSV and other tables; - is stdin.", metavar="FILE..."),
]
File = Annotated[
    Path, typer.Argument(help="MCAP, BLF, ASC, candump .log, MF4, CSV and other tables; - is stdin.", metavar="FILE")
]
Vehicle = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        metavar="NAME",
        help="Vehicle; default: as recorded, else the file's name.",
        callback=vehicle_name,
    ),
]


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sprung {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Springs and dampers of rail vehicles, identified from running recordings."""


@app.command()
def replay(
    files: Files,
    system: System = None,
    dbc: Dbc = None,
    store: StoreUrl = None,
    weights: Weights = None,
    vehicle: Vehicle = None,
    speed: Annotated[
        float,
        typer.Option(
            "--speed",
            metavar="FACTOR",
            min=0,
            help="Times real time; 0: as fast as possible.",
            callback=finite_speed,
        ),
    ] = 0.0,
    start: Start = None,
    json_lines: Json = False,
) -> int:
    """Identify recordings window by window, and track.

    Without --store nothing is kept: every run then depends on its files alone.
    """
    one_thread_each()
    from sprung.service.cli.replay import ReplayOptions, run

    return run(files, ReplayOptions(system, dbc, store, weights, vehicle, speed, start, json_lines))


@app.command()
def serve(
    system: System = None,
    dbc: Dbc = None,
    store: StoreUrl = None,
    weights: Weights = None,
    data_dir: Annotated[
        Path | None, typer.Option("--data-dir", metavar="FOLDER", help="Uploads, reports and the embedded store.")
    ] = None,
    host: Annotated[
        str | None, typer.Option("--host", metavar="ADDRESS", help="Address to listen on; default 127.0.0.1.")
    ] = None,
    port: Annotated[
        int | None, typer.Option("--port", metavar="NUMBER", min=0, max=65535, help="Default 8000; 0: any free one.")
    ] = None,
    replay_files: Annotated[
        list[Path] | None,
        typer.Option("--replay", metavar="FILE", help="Recording to replay into the service; repeatable."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(
            "--speed",
            metavar="FACTOR",
            min=0,
            help="Of --replay: times real time; 0: as fast as possible.",
            callback=finite_speed,
        ),
    ] = 0.0,
    can: Annotated[
        list[str] | None,
        typer.Option(
            "--can", metavar="BUS", help="Live bus, as socketcan:can0 or pcan:PCAN_USBBUS1,bitrate=500000; repeatable."
        ),
    ] = None,
    vehicle: Vehicle = None,
    start: Start = None,
) -> int:
    """Run the service: API, metrics and pages.

    On an embedded store unless --store says otherwise.
    """
    check_address_space()
    one_thread_each()
    with lasting_imports():
        from sprung.service.cli.serve import run

    options = {
        "system": system,
        "dbc": dbc,
        "store": store,
        "weights": weights,
        "data_dir": data_dir,
        "host": host,
        "port": port,
    }
    return run(options, replay_files or [], speed, can or [], vehicle, start)


@app.command()
def train(
    more: Annotated[
        list[Path] | None, typer.Argument(help="Further recordings, after --recordings.", metavar="[FILE...]")
    ] = None,
    system: System = None,
    recordings: Annotated[
        list[Path] | None,
        typer.Option("--recordings", metavar="FILE...", help="Continue training with these, without labels."),
    ] = None,
    dbc: Dbc = None,
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="Folder for the weights.")] = Path("weights"),
    seed: Annotated[int | None, typer.Option("--seed", metavar="NUMBER", help="Same seed, same weights.")] = None,
    records: Annotated[
        int | None, typer.Option("--records", metavar="NUMBER", min=1, help="Simulated records.")
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", metavar="NUMBER", min=1, help="Optimiser steps.")] = None,
) -> int:
    """Train the estimator for a system (optional).

    It saves time, not accuracy; training goes on after an interrupt.
    """
    from sprung.service.cli.train import run

    return run(
        system, [*(recordings or []), *(more or [])], dbc, out, {"seed": seed, "records": records, "steps": steps}
    )


@app.command()
def diagnose(
    file: File,
    system: System = None,
    dbc: Dbc = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PATH", help="Folder for the page and the pictures.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", metavar="TEXT", help="Name of the recording in the report.")
    ] = None,
    start: Start = None,
    write_system: Annotated[
        Path | None, typer.Option("--write-system", metavar="FILE", help="Write the system file with the findings.")
    ] = None,
    laws: Annotated[
        Path | None,
        typer.Option("--laws", metavar="FILE", help="Python file with laws of your own; it is run: trust it."),
    ] = None,
    write_laws: Annotated[
        Path | None,
        typer.Option("--write-laws", metavar="FILE", help="Write formulas that were found as laws for --laws."),
    ] = None,
    json_lines: Json = False,
) -> int:
    """Find unmodelled dynamics: where, which law, how much.

    The report says how much better the simulation fits with it.
    """
    one_thread_each()  # candidates are fitted beside each other
    hand_over_often()
    from sprung.service.cli.diagnose import DiagnoseOptions, run

    return run(file, system, dbc, DiagnoseOptions(out, name, start, write_system, laws, write_laws), json_lines)


@app.command()
def simulate(
    system_file: Annotated[Path, typer.Argument(help="System file, with laws where it has them.", metavar="SYSTEM")],
    inputs: Annotated[Path, typer.Option("--inputs", help="Recording whose measured inputs drive the simulation.")],
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="Recording to write: .mcap .csv .blf .asc .log.")],
    dbc: Dbc = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=NUMBER", help="Change a value, as in car.mass=34000.")
    ] = None,
    noise: Annotated[
        bool, typer.Option("--noise", metavar="NUMBER", help="Add the sensors' noise of the system file.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", metavar="NUMBER", help="Seed of the noise.")] = 0,
    start: Start = None,
) -> int:
    """Simulate a vehicle's sensors, and write a recording.

    With the laws of its system file.
    """
    from sprung.service.cli.simulate import simulate as run

    return run(system_file, inputs, out, dbc, settings or [], noise, seed, start)


@app.command()
def compare(
    measured: Annotated[Path, typer.Argument(help="Recording.", metavar="A")],
    other: Annotated[
        Path, typer.Argument(help="Second recording, or a system file that is simulated on A's inputs.", metavar="B")
    ],
    system: System = None,
    dbc: Dbc = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PATH", help="Folder for pictures of signals and force loops.")
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="TIME", help="When A began, if its times count from 0.")
    ] = None,
    json_lines: Json = False,
) -> int:
    """Compare a simulation with a recording.

    Errors of every sensor, residual spectra, force loops.
    """
    from sprung.service.cli.simulate import show as run

    return run(measured, other, system, dbc, out, json_lines, start)


@app.command()
def experiment(
    models: Annotated[
        list[Path],
        typer.Argument(help="System files of the models, or a report of `sprung diagnose`.", metavar="MODEL..."),
    ],
    system: Annotated[
        Path | None, typer.Option("--system", help="With a report: the system file with its findings.")
    ] = None,
    menu: Annotated[Path | None, typer.Option("--menu", help="Possible runs; default: a built-in menu.")] = None,
    known: Annotated[
        float | None, typer.Option("--known", metavar="NUMBER", help="How well springs and dampers are known: 0.05.")
    ] = None,
    json_lines: Json = False,
) -> int:
    """Find the run that distinguishes look-alikes best.

    With the evidence that is expected of it.
    """
    from sprung.service.cli.experiment import run

    return run(models, system, menu, known, json_lines)


@app.command()
def inspect(
    file: File,
    system: Annotated[
        Path | None,
        typer.Option("--system", metavar="FILE", help="Take time and CAN database as this system file says."),
    ] = None,
    dbc: Dbc = None,
    time_column: Annotated[str | None, typer.Option("--time-column", help="Time column of a table.")] = None,
    time_unit: Annotated[str | None, typer.Option("--time-unit", help="Unit of that column: s, ms, us, ns ...")] = None,
    rate: Annotated[float | None, typer.Option("--rate", help="Sample rate in Hz of a table without times.")] = None,
    write_system: Annotated[
        Path | None, typer.Option("--write-system", help="Write the skeleton of a system file here.")
    ] = None,
    json_lines: Json = False,
) -> int:
    """Show what a recording holds.

    Signals, rates, units, gaps, ranges, spectra.
    """
    from sprung.service.cli.inspect import run

    return run(
        file,
        system_file=system,
        dbc=dbc,
        column=time_column,
        unit=time_unit,
        rate=rate,
        write_system=write_system,
        json_lines=json_lines,
    )


@app.command()
def system(
    file: Annotated[Path | None, typer.Argument(help="System file; default: the Manchester vehicle.")] = None,
    json_lines: Json = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of system files, for editors.")
    ] = False,
    export: Annotated[
        Path | None,
        typer.Option(
            "--export", metavar="FILE", help="Write the model: .fmu .mo .mat .npz, or a folder for force tables."
        ),
    ] = None,
) -> int:
    """Check a system file; show or export its model.

    Bodies, elements, modes, and what the sensors can identify.
    """
    from sprung.service.cli.system import run

    return run(file, json_lines, schema, export)


@app.command("import")
def import_model(
    file: Annotated[
        Path,
        typer.Argument(help=".mat file with M, C, K and sensor rows, or A, B, C, D; or an FMU.", metavar="MODEL"),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="System file to write.")],
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", metavar="NUMBER", help="Sample rate in Hz of the recordings; default: `sample_rate` in the file."
        ),
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the system; default: the file's.")] = None,
) -> int:
    """Make a system file from a linear model's matrices.

    A baseline for identification and diagnosis.
    """
    from sprung.service.cli.system import import_matrices

    return import_matrices(file, out, rate, name)


@app.command()
def export(
    vehicle: Annotated[str, typer.Argument(help="Vehicle, as named in the recordings.", metavar="VEHICLE")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Default: standard output, as CSV.")] = None,
    kind: Annotated[
        str | None,
        typer.Option("--format", metavar="KIND", help="csv, parquet or mcap; default: the suffix of --out."),
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--parameter", metavar="NAME", help="Repeatable; default: all.")
    ] = None,
    since: Annotated[str | None, typer.Option("--since", metavar="TIME", help="RFC 3339, inclusive.")] = None,
    until: Annotated[str | None, typer.Option("--until", metavar="TIME", help="RFC 3339, exclusive.")] = None,
    resolution: Annotated[
        str, typer.Option("--resolution", metavar="SECONDS", help="Per point (60, 1m, 6h); raw: single windows.")
    ] = "raw",
    system: System = None,
    store: StoreUrl = None,
    weights: Weights = None,
) -> int:
    """Write the history of a vehicle's parameters to a file.

    Out of a store.
    """
    one_thread_each()
    from sprung.service.cli.history import run

    return run(
        vehicle,
        system=system,
        weights=weights,
        store=store,
        out=out,
        kind=kind,
        parameters=parameter or [],
        since=since,
        until=until,
        resolution=resolution,
    )


@app.command()
def doctor(
    system: System = None,
    dbc: Dbc = None,
    store: StoreUrl = None,
    weights: Weights = None,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", metavar="FOLDER", help="As for sprung serve.")] = None,
    can: Annotated[
        list[str] | None, typer.Option("--can", metavar="INTERFACE:CHANNEL", help="Listen to this bus; repeatable.")
    ] = None,
) -> int:
    """Check the installation; a line each, and what to do.

    Packages, model, CAN database, store, disk, clock and buses.
    """
    one_thread_each()
    from sprung.service.cli.doctor import run

    options = {"system": system, "dbc": dbc, "weights": weights, "store": store, "data_dir": data_dir}
    return run(options, can or [])


@app.command(  # a benchmark's own help is printed by it
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
)
def bench(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Without a name, all benchmarks are listed.")] = None,
) -> int:
    """Run a benchmark: one JSON line per figure.

    Further arguments go to it (--budget full, --data DIR); sprung bench NAME --help describes them.
    """
    one_thread_each()  # as the commands that it measures do; before anything numerical is loaded
    from sprung.service.cli.bench import HELP, run

    if name in HELP:
        typer.echo(context.get_help())
        return 0

    return run(name, context.args)


for command in (store_commands.retention, store_commands.backup, store_commands.restore, fleet_commands.edge):
    app.command()(command)
app.add_typer(fleet_commands.fleet, name="fleet")
app.add_typer(store_commands.token, name="token")
