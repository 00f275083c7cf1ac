"""`sprung simulate` and `sprung compare`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sprung.model.laws import CATALOGUE, Law
from sprung.model.signals import Channel
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import MANCHESTER, System, load_system
from sprung.model.text import counted
from sprung.replay.plausibility import plausible_range
from sprung.replay.record import Record
from sprung.replay.writing import WRITERS, UnwritableRecording, without_address, write_recording
from sprung.service.can_database import database_of
from sprung.service.cli import apart
from sprung.service.cli.start_time import start_time
from sprung.service.cli.targets import check_file, check_folder
from sprung.service.errors import UserError
from sprung.service.report.recordings import SYSTEM_FILES, Comparison, compare
from sprung.service.sources.loading import DrivingRecord, DrivingRequest, RecordRequest


def simulate(
    system_file: Path,
    inputs: Path,
    out: Path,
    dbc: Path | None,
    settings: list[str],
    noise: bool,
    seed: int,
    start: str | None = None,
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
    changed, circumstances = _settings(system, settings)
    began = start_time(start, [inputs])
    request = RecordRequest(inputs, system.channels, system.sample_rate, database, system.time, began)
    drive = apart.load_driving(DrivingRequest(request, system.auxiliary))
    record = drive.record
    driven = record.values[:, : len(system.inputs)]
    ride = simulate_ride(system, driven, changed, noise=np.random.default_rng(seed) if noise else None)
    beside, missing = _circumstances(system, drive, circumstances, out)
    values = np.concatenate([driven, ride.sensors, drive.beside[:, beside]], axis=1)
    channels = (*system.channels, *(system.auxiliary[index] for index in beside))
    if out.suffix.lower() not in (".csv", ".mcap"):
        _check_frames(channels, [channel for channel in system.auxiliary if channel not in channels])
    write_recording(out, channels, values, system.sample_rate, record.start, dbc=database, vehicle=record.vehicle)
    laws = ", ".join(f"{law.law.name} at {law.location}" for law in system.laws) or "none"
    print(
        f"{out}: {counted(len(values), 'sample')} of {counted(len(channels), 'channel')}; laws: {laws}",
        file=sys.stderr,
    )
    if missing:
        print(f"sprung: {out}: is without {'; '.join(missing)}", file=sys.stderr)
    return 0


def _settings(system: System, texts: list[str]) -> tuple[dict[str, float], dict[str, float]]:
    """Values of the vehicle that are changed, and those of speed, temperature and the like, by name."""
    known = {channel.name: channel for channel in system.auxiliary}
    vehicle: dict[str, float] = {}
    beside: dict[str, float] = {}
    for name, value in map(_setting, texts):
        if name in vehicle or name in beside:
            raise UserError(f"--set {name}: is given twice")
        if name not in known:
            vehicle[name] = value
            continue
        lowest, highest = plausible_range(known[name])
        if not lowest <= value <= highest:  # True for NaN
            limits = f"from {lowest:g} to {highest:g} {known[name].unit}"
            raise UserError(f"--set {name}={value:g}: {name} lies {limits}; another `range` is for the system file")
        beside[name] = value
    return vehicle, beside


def _circumstances(
    system: System, drive: DrivingRecord, given: dict[str, float], out: Path
) -> tuple[list[int], list[str]]:
    """Which of the auxiliary channels are written, and a phrase for each of the others.

    They are as they were given, else as in the ride; a pressure goes with the load, which is another one here.
    """
    written, missing = [], []
    for index, channel in enumerate(system.auxiliary):
        if channel.name in given:
            drive.beside[:, index] = given[channel.name]
        if (key := without_address(out, channel)) is not None:
            missing.append(f"{channel.name}, which has no `{key}` address in the system file")
        elif channel.name not in given and channel.unit == "Pa":
            missing.append(f"{channel.name}, which depends on the load: give it by --set {channel.name}=NUMBER")
        elif not np.isfinite(drive.beside[:, index]).all():
            missing.append(f"{channel.name}, which is not in the recording: give it by --set {channel.name}=NUMBER")
        else:
            written.append(index)
    return written, missing


def _check_frames(written: Sequence[Channel], left_out: Sequence[Channel]) -> None:
    """A frame has a number for each of its signals: what shares one cannot be left out.  Errors: `UserError`."""
    frames = {_frame(channel): channel.name for channel in written}
    for channel in left_out:
        if (beside := frames.get(_frame(channel))) is not None and channel.can is not None:
            raise UserError(
                f"{channel.name} would be written as 0, in one CAN message with {beside}: "
                f"give it by --set {channel.name}=NUMBER, or write .mcap"
            )


def _frame(channel: Channel) -> str:
    return "" if channel.can is None else channel.can.rpartition(".")[0]


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
    start: str | None = None,
    catalogue: tuple[Law, ...] = CATALOGUE,
) -> int:
    """Print the errors of every sensor; with a folder, draw them.  A system file alone reads the recording, too."""
    check_folder(out)
    simulated = other if other.suffix.lower() in SYSTEM_FILES else MANCHESTER
    system = load_system(system_file or simulated, catalogue)
    database, began = database_of(system, dbc), start_time(start, [measured])

    def load(path: Path) -> Record:
        at = began if path == measured else None
        return apart.load(RecordRequest(path, system.channels, system.sample_rate, database, system.time, at))

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
