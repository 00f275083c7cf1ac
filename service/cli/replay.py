"""`sprung replay`."""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sprung.model.signals import Channel
from sprung.service.cli.apart import own_limits, readable
from sprung.service.cli.console import print_table, width_of_output
from sprung.service.cli.parameters import parameter_table
from sprung.service.cli.progress import progress
from sprung.service.cli.start_time import start_time
from sprung.service.cli.stdin import CALLED, spooled
from sprung.service.jobs.recordings import add_row, file_row, finish_row
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch
from sprung.service.monitoring.views import (
    VehicleView,
    alarm_dict,
    changed_part,
    load_parameters,
    vehicle_view,
    window_dict,
)
from sprung.service.monitoring.words import fault_in_words, size_in_words
from sprung.service.settings import Settings, settings_with
from sprung.service.sources.feed import FeedResult, comfort_dict, feed_file
from sprung.service.store import open_store
from sprung.service.times import to_iso

SLACK_SECONDS = 3.0  # to start
KEPT_UP = 0.9  # of the speed asked for


@dataclass(frozen=True)
class ReplayOptions:
    """How recordings are replayed."""

    system: Path | None
    dbc: Path | None
    store: str | None  # None: nothing is kept, and a run depends on its files alone
    weights: Path | None
    vehicle: str | None
    speed: float  # times real time; 0: as fast as possible
    start: str | None  # when the recordings began
    json_lines: bool


def run(files: list[Path], options: ReplayOptions) -> int:
    """Replay each file; 1 when a vehicle has alarms or a recording was incomplete."""
    given = {"system": options.system, "dbc": options.dbc, "store": options.store, "weights": options.weights}
    settings = settings_with(given)
    for path in files:
        if str(path) != "-":
            readable(path)
    began = start_time(options.start, files)
    with ExitStack() as stack:
        pipeline = _pipeline(settings, stack)
        return max(_replay(pipeline, settings, options, named, began) for named in files)


def _pipeline(settings: Settings, stack: ExitStack) -> Pipeline:
    engine = load_engine(settings)
    url = settings.store_url
    if settings.store is None:
        url = f"sqlite:///{stack.enter_context(tempfile.TemporaryDirectory(prefix='sprung-'))}/replay.db"
    store = open_store(url)
    stack.callback(store.close)
    compute = Compute(settings.compute_queue)
    stack.callback(compute.close)
    return Pipeline(engine, store, compute, vehicles_in_memory=settings.vehicles_in_memory)


def _replay(pipeline: Pipeline, settings: Settings, options: ReplayOptions, named: Path, start: int | None) -> int:
    """Replay a file and print the outcome; the exit status of it."""
    with ExitStack() as stack:
        path = spooled(named, stack)
        called = named if path is named else CALLED
        fed = _fed(pipeline, settings, options, path, start)
    status = _report(pipeline, called, fed, options.json_lines)
    remark = slower_line(fed, options.speed)
    if remark:
        print(f"sprung: {called}: {remark}", file=sys.stderr)
    return status


def _fed(pipeline: Pipeline, settings: Settings, options: ReplayOptions, path: Path, start: int | None) -> FeedResult:
    system, store = pipeline.engine.system, pipeline.store
    row = file_row(path, start)
    add_row(store, row)
    kept = Counter[str]()
    with (
        reporting_what_is_kept(kept, None if settings.store is None else store.engine.url),
        progress(path.name, system.hop / system.sample_rate, quiet=options.json_lines) as show,
    ):

        def on_batch(batch: Batch) -> None:
            kept["windows"] += len(batch.records)
            if options.json_lines:
                lines = (json.dumps(window_dict(pipeline.engine, record)) for record in batch.records)
                sys.stdout.write("\n".join(lines) + "\n")
            show(batch)

        fed = feed_file(
            pipeline,
            path,
            vehicle=options.vehicle,
            recording_id=row.id,
            batch_windows=settings.batch_windows,
            speed=options.speed,
            start=start,
            limits=own_limits(settings, path),
            on_batch=on_batch,
        )
    finish_row(store, row, fed)
    return fed


@contextmanager
def reporting_what_is_kept(kept: Counter[str], url: object | None) -> Iterator[None]:
    """After Ctrl-C: what is stored, and how to continue.  url: of the store; None if it is temporary."""
    try:
        yield
    except KeyboardInterrupt:
        if url is None:
            line = f"{kept['windows']} windows were followed and nothing is kept; with --store they would be"
        else:
            line = f"{kept['windows']} windows are kept in {url}; call it again to go on"
        print(f"sprung: {line}", file=sys.stderr)
        raise


def _report(pipeline: Pipeline, path: Path, fed: FeedResult, json_lines: bool) -> int:
    """Print the outcome; the exit status of this file."""
    assert fed.state is not None
    view = vehicle_view(pipeline.engine, fed.vehicle, fed.state, None)
    if json_lines:
        print(json.dumps({"summary": summary(pipeline, view, fed)}), flush=True)
    else:
        print_table(parameter_table(replace(view, health=health(view, fed)), width_of_output()))
        print(closing_line(view, fed, pipeline.engine.system.channels))
    complaint = incomplete_line(path, fed)
    for line in fed.problems:
        if line not in (complaint or ""):
            print(f"sprung: {path}: {line}", file=sys.stderr)
    if complaint:
        print(f"sprung: {complaint}", file=sys.stderr)
    return int(bool(complaint) or bool(view.active) or not fed.monitored)


def summary(pipeline: Pipeline, view: VehicleView, fed: FeedResult) -> dict[str, Any]:
    """The last line of `replay --json`."""
    return {
        "vehicle": fed.vehicle,
        "health": health(view, fed),
        "windows": dict(fed.windows),
        "fitting": fed.fitting,
        "frames": fed.tally.as_dict(),
        "samples": {"expected": fed.expected, "lost": fed.lost},
        "problems": fed.problems[:20],
        "parameters": [p.as_dict() for p in view.parameters] + load_parameters(pipeline.engine, view),
        "alarms": [alarm_dict(alarm) for alarm in view.alarms],
        "comfort": comfort_dict(pipeline, fed),
        **view.measurements(),
        "recorded_seconds": fed.recorded_seconds,
        "wall_seconds": round(fed.wall_seconds, 3),
    }


def health(view: VehicleView, fed: FeedResult) -> str:
    """The vehicle's health; an uninformative recording asks for a functional check."""
    return view.health if fed.monitored or view.health == "failure" else "check_function"


def slower_line(fed: FeedResult, speed: float) -> str | None:
    """What to say of a replay that did not keep up with the speed that was asked for; None where it did."""
    recorded = fed.recorded_seconds
    pace = recorded / max(fed.wall_seconds, 1e-9)
    if speed <= 0 or fed.wall_seconds < recorded / speed + SLACK_SECONDS or pace > KEPT_UP * speed:
        return None
    return f"--speed {speed:g} was asked for and {pace:.2g} reached: this machine, busy as it is, is no faster"


def closing_line(view: VehicleView, fed: FeedResult, channels: Sequence[Channel]) -> str:
    """Closing line: data read, speed, and alarms.  channels: of the system."""
    recorded = fed.recorded_seconds
    counts = ", ".join(f"{count} {outcome}" for outcome, count in fed.windows.items())
    pace = recorded / max(fed.wall_seconds, 1e-9)
    lines = [f"{recorded:.1f} s recorded in {fed.wall_seconds:.1f} s ({pace:.0f} x real time); windows: {counts}"]
    if fed.adequate < fed.windows["used"] + fed.windows["repaired"]:
        lines.append(f"{fed.adequate} of {fed.windows['used'] + fed.windows['repaired']} windows fit the model")
    if fed.stored_before:
        lines.append(f"{fed.stored_before} window{'s were' if fed.stored_before != 1 else ' was'} in the store already")
    for alarm in view.active:
        what = changed_part(alarm) or "windows do not fit the model"
        advice = "; `sprung diagnose` looks for the cause" if alarm.kind == "misfit" else ""
        change = f" {size_in_words(alarm.parameter, alarm.change, alarm.std)}".rstrip()
        apart = "; the measurements do not distinguish them" if alarm.alternatives else ""
        lines.append(f"{alarm.severity}: {what}{change} since {to_iso(alarm.onset)}{apart}{advice}")
    return "\n".join([*lines, *measurement_lines(view.measurements(), {c.name: c.unit for c in channels})])


def measurement_lines(found: dict[str, Any], units: Mapping[str, str]) -> list[str]:
    """What was found wrong with measurements, and the loads.  units: of the channels."""
    lines = []
    for fault in found.get("sensors", []):
        unit = units.get(fault["channel"], "")
        lines.append(f"sensor: {fault['channel']} {fault_in_words(fault['kind'], fault['value'], fault['std'], unit)}")
    lines += [
        f"system file: {one['body']} is {100 * one['change']:+.1f} % ± {100 * one['std']:.1f} % in {one['what']}"
        for one in found.get("built", [])
    ]
    loads = found.get("load") or {}
    before = f", as of {found['load_as_of']}; not observable since" if found.get("load_as_of") else ""
    return lines + [
        f"load: {body} {mass:+z.0f} ± {std:.0f} kg against nominal{before}" for body, (mass, std) in loads.items()
    ]


def incomplete_line(path: Path, fed: FeedResult) -> str | None:
    """One line that says how much of a recording was lost; None when nothing was."""
    parts = []
    if fed.lost:
        parts.append(f"{fed.lost} of {fed.expected} samples lost ({100 * fed.lost / max(fed.expected, 1):.2g} %)")
    bad = {name: count for name in ("dropped", "corrupt") if (count := fed.tally.as_dict()[name])}
    parts += [f"{_counted(count, 'message')} {name}" for name, count in bad.items()]
    if fed.windows["repaired"]:
        parts.append(f"{_counted(fed.windows['repaired'], 'window')} repaired")
    if fed.windows["dropped"]:
        why = ", ".join(f"{reason}: {count}" for reason, count in fed.reasons.most_common(3))
        parts.append(f"{_counted(fed.windows['dropped'], 'window')} dropped ({why})")
    if fed.late:
        parts.append(f"{_counted(fed.late, 'window')} not tracked: older than what was known of {fed.vehicle}")
    parts += fed.problems[:3] if fed.incomplete else []
    if not parts:
        return None
    total = sum(fed.windows.values())
    verdict = "incomplete" if fed.monitored else "not monitored"
    return f"{path}: {verdict}: {', '.join(parts)}; {_counted(total, 'window')} in all"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
