"""`sprung simulate` and `sprung compare`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from sprung.model.laws import CATALOGUE, Law
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import MANCHESTER, load_system
from sprung.model.text import counted, some
from sprung.replay.record import Record
from sprung.replay.writing import WRITERS, UnwritableRecording, write_recording
from sprung.service.can_database import database_of
from sprung.service.cli import apart
from sprung.service.cli.targets import check_file, check_folder
from sprung.service.errors import UserError
from sprung.service.report.recordings import SYSTEM_FILES, Comparison, compare
from sprung.service.sources.loading import RecordRequest


def simulate(
    system_file: Path,
    inputs: Path,
    out: Path,
    dbc: Path | None,
    settings: list[str],
    noise: bool,
    seed: int,
    catalogue: tuple[Law, ...] = CATALOGUE,
) -> int:
    """Write the recording that a vehicle with the file's laws would give on the inputs of another one."""
    if out.suffix.lower() not in WRITERS:
        raise UnwritableRecording(f"{out}: cannot write files of this kind; known are {' '.join(sorted(WRITERS))}")
    if out.exists() and out.resolve() == inputs.resolve():
        raise UserError(f"{out}: is the file that the inputs come from")
    check_file(out)
    system = load_system(system_file, catalogue)
    database = database_of(system, dbc)
    record = apart.load(RecordRequest(inputs, system.channels, system.sample_rate, database, system.time, None))
    driven = record.values[:, : len(system.inputs)]
    ride = simulate_ride(
        system, driven, dict(map(_setting, settings)), noise=np.random.default_rng(seed) if noise else None
    )
    values = np.concatenate([driven, ride.sensors], axis=1)
    write_recording(
        out, system.channels, values, system.sample_rate, record.start, dbc=database, vehicle=record.vehicle
    )
    laws = ", ".join(f"{law.law.name} at {law.location}" for law in system.laws) or "none"
    print(
        f"{out}: {counted(len(values), 'sample')} of {counted(len(system.channels), 'channel')}; laws: {laws}",
        file=sys.stderr,
    )
    if system.auxiliary:
        names = some([channel.name for channel in system.auxiliary], 5)
        print(f"sprung: {out}: holds inputs and sensors alone, not {names}", file=sys.stderr)
    return 0


def _setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise UserError(f"--set {text}: NAME=NUMBER is expected, as in secondary_1l.damping=15000") from None


def show(
    measured: Path,
    other: Path,
    system_file: Path | None,
    dbc: Path | None,
    out: Path | None,
    json_lines: bool,
    catalogue: tuple[Law, ...] = CATALOGUE,
) -> int:
    """Print the errors of every sensor; with a folder, draw them.  A system file alone reads the recording, too."""
    check_folder(out)
    simulated = other if other.suffix.lower() in SYSTEM_FILES else MANCHESTER
    system = load_system(system_file or simulated, catalogue)
    database = database_of(system, dbc)

    def load(path: Path) -> Record:
        return apart.load(RecordRequest(path, system.channels, system.sample_rate, database, system.time, None))

    found = compare(measured, other, system, load)
    per_sensor = {
        name: round(float(value), 6)
        for name, value in zip(system.sensors, found.nrmse, strict=True)
        if np.isfinite(value)
    }
    pictures = _drawn(found, out) if out is not None else []
    if json_lines:
        print(json.dumps({"nrmse": round(found.pooled, 6), "per_sensor": per_sensor, "pictures": pictures}))
        return 0
    for name, value in sorted(per_sensor.items(), key=lambda item: -item[1]):
        print(f"{name:<24} {100 * value:6.2f} %")
    print(f"{'all':<24} {100 * found.pooled:6.2f} %  of the measured rms, over {found.time[-1]:.1f} s")
    for picture in pictures:
        print(picture)
    return 0


def _drawn(found: Comparison, out: Path) -> list[str]:
    from sprung.service.report import ink  # matplotlib takes a second
    from sprung.service.report.comparison import loops_figure, signals_figure

    out.mkdir(parents=True, exist_ok=True)
    figures = {"signals.png": signals_figure(found), "loops.png": loops_figure(found)}
    return [str(ink.save(figure, out / name)) for name, figure in figures.items() if figure is not None]
