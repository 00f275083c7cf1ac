"""An alarm as one file: raw signals, simulation, residuals, estimates and events, for Foxglove and its like."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.service.diagnosis.alarm_signals import Stretch
from sprung.service.export.messages import COMPARED, ESTIMATE, FIT, SIGNAL, McapSink
from sprung.service.export.tables import estimate, values_of
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.ring import Excerpt
from sprung.service.monitoring.simulated import Compared
from sprung.service.monitoring.views import changed_part
from sprung.service.monitoring.words import size_in_words
from sprung.service.store.fleet import AlarmRow
from sprung.service.store.history import Series
from sprung.service.store.marks import MarkRow
from sprung.service.times import NANOSECONDS

BUNDLE_MEDIA = "application/octet-stream"
INFO, WARNING, ERROR = 2, 3, 4  # levels of foxglove.Log


@dataclass(frozen=True, slots=True)
class Bundle:
    """What the store knows of a vehicle."""

    vehicle: str
    series: Series
    alarms: Sequence[AlarmRow]
    marks: Sequence[MarkRow]
    stretch: Stretch | None  # whose samples the file holds
    reason: str  # which they are, and why


def bundle(engine: Engine, found: Bundle, excerpt: Excerpt | None, windows: Sequence[Compared]) -> bytes:
    """The file.  Topics: /signals/CHANNEL, /compared/SENSOR, /fit, /estimate/ELEMENT/QUANTITY, /events."""
    sink = io.BytesIO()
    about = {"vehicle": found.vehicle, "model": engine.digest, "system": engine.system.name}
    with McapSink(sink, about) as file:
        if excerpt is not None:
            _signals(file, engine, excerpt)
        for window in windows:
            _compared(file, engine, window)
        for parameter in engine.system.tracked:
            value, std = values_of(engine, parameter.name, found.series)
            topic = f"/estimate/{parameter.element}/{parameter.quantity}"
            for i in np.flatnonzero(np.isfinite(value)).tolist():
                file.write(topic, ESTIMATE, int(found.series.time[i]), estimate(value[i], std[i], parameter.nominal))
        _contents(file, found, excerpt, windows)
        for alarm in found.alarms:
            _alarm(file, alarm)
        for mark in found.marks:
            file.event(mark.time_ns, INFO, mark.kind, f"{mark.text} ({mark.author})")
    return sink.getvalue()


def _contents(file: McapSink, found: Bundle, excerpt: Excerpt | None, windows: Sequence[Compared]) -> None:
    """An event that describes the contents of the file and what is missing."""
    text, level = found.reason, INFO
    if excerpt is None:
        level = WARNING
        if found.stretch is not None:
            text += "; they could not be read, or other channels were measured then: this file has none of them"
    elif not windows:
        text += "; none of their windows is whole, or nothing drives the model: there is no simulation to compare"
    last = found.series.time[-1] if len(found.series.time) else 0
    file.event(int(last) if found.stretch is None else found.stretch.end, level, "bundle", text)


def _signals(file: McapSink, engine: Engine, excerpt: Excerpt) -> None:
    for column, channel in enumerate(engine.system.channels):
        for row in np.flatnonzero(np.isfinite(excerpt.values[:, column])).tolist():
            time = excerpt.start + round(row * NANOSECONDS / excerpt.sample_rate)
            file.write(f"/signals/{channel.name}", SIGNAL, time, {"value": float(excerpt.values[row, column])})


def _compared(file: McapSink, engine: Engine, window: Compared) -> None:
    step = NANOSECONDS / window.sample_rate
    for i, name in enumerate(engine.system.sensors):
        for row in range(len(window.simulated)):
            measured, simulated = float(window.measured[row, i]), float(window.simulated[row, i])
            message = {"simulated": simulated}
            if np.isfinite(measured):
                message |= {"measured": measured, "residual": measured - simulated}
            file.write(f"/compared/{name}", COMPARED, window.start + round(row * step), message)
    if np.isfinite(window.estimate.nrmse):
        message = {"nrmse": float(window.estimate.nrmse), "adequate": bool(window.estimate.adequate)}
        file.write("/fit", FIT, window.start, message)


def _alarm(file: McapSink, alarm: AlarmRow) -> None:
    level = ERROR if alarm.severity == "alarm" else WARNING
    what = changed_part(alarm) or "windows do not fit the model"
    change = f" {size_in_words(alarm.parameter, alarm.change, alarm.std)}".rstrip()
    file.event(alarm.onset, level, alarm.kind, f"{alarm.severity}: {what}{change}: begins here")
    file.event(alarm.opened, level, alarm.kind, f"{alarm.severity}: {what}{change}: raised")
    if alarm.closed is not None:
        file.event(alarm.closed, INFO, alarm.kind, f"{what}: recovered")
