"""Sprung from Python: a system, its recordings, and what they determine of springs and dampers.

Everything here is also reached as `sprung.NAME`.  Arrays are float64 in SI units; T samples, C channels, I measured
inputs, S sensors, P parameters.  Input that cannot be used raises a ValueError of one line.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sprung.model.diagnosis.api import diagnose
from sprung.model.identification.identify import load_identifier
from sprung.model.identifier import Identifies, UnusableWindow
from sprung.model.signals import Estimate, FloatArray, Window
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, load_system, parse_system
from sprung.model.tracking.tracker import Alarm, ParameterReport
from sprung.replay.auxiliary import AuxiliaryMeans
from sprung.replay.record import Record
from sprung.replay.recording import Recording
from sprung.service.can_database import database_of
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.monitoring.following import FollowedVehicle
from sprung.service.report.writing import write_report
from sprung.service.sources.opening import open_record, open_stream
from sprung.service.sources.reading import windower_of
from sprung.service.times import now_ns

__all__ = [
    "IdentifiedWindow",
    "ParameterValue",
    "Tracked",
    "diagnose",
    "identify",
    "load_record",
    "load_system",
    "open_recording",
    "parse_system",
    "simulate",
    "track",
    "write_report",
]

AT_ONCE = 128  # windows that are identified together


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """One identified parameter.

    >>> import sprung
    >>> system = sprung.load_system()
    >>> record = sprung.load_record("ride.mcap", system)
    >>> spring = sprung.identify(system, record.values[:100])["primary_11l.stiffness"]
    >>> spring.unit, spring.nominal, spring.std < 0.1 * spring.value
    ('N/m', 1220000.0, True)
    """

    name: str  # "secondary_2l.damping"
    value: float  # `unit`
    std: float  # standard deviation, `unit`
    unit: str
    nominal: float  # `unit`
    identifiable: bool  # False: the window does not determine it; value and std are those of the prior


@dataclass(frozen=True, slots=True)
class IdentifiedWindow:
    """What one window identified.

    >>> import sprung
    >>> system = sprung.load_system()
    >>> window = sprung.identify(system, sprung.load_record("ride.mcap", system).values[:100])
    >>> len(window.parameters), window.estimate.adequate
    (24, True)
    """

    parameters: tuple[ParameterValue, ...]
    estimate: Estimate  # the same as log-ratios with their covariance, and how well the window fits

    def __getitem__(self, name: str) -> ParameterValue:
        """A parameter by name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter {name!r}; there are {', '.join(p.name for p in self.parameters)}")


@dataclass(frozen=True, slots=True)
class Tracked:
    """What a recording came to.

    >>> import sprung
    >>> system = sprung.load_system()
    >>> tracked = sprung.track(system, sprung.open_recording("ride.mcap", system))
    >>> tracked.windows, tracked.alarms, tracked.health
    (39, (), 'ok')
    """

    parameters: tuple[ParameterReport, ...]  # posterior, baseline and drift of every parameter
    alarms: tuple[Alarm, ...]
    health: str  # ok | maintenance_required | out_of_specification | check_function
    windows: int  # that were tracked


def open_recording(
    path: str | Path, system: System, dbc: str | Path | None = None, start: int | None = None
) -> Recording:
    """A recording as a stream of samples of the system's channels; `.blocks()` reads it, once.

    dbc: the CAN database of a BLF, ASC, candump or MF4 file; the bundled one where the system's CAN signals are of it.
    start: ns since 1970, when it began if its times count from 0; the file's own time otherwise.  The unit of a time
    column and where it stands are as the system file's `time` says.
    Errors: `UnreadableRecording`, one line, now or while reading.

    >>> import sprung
    >>> ride = sprung.open_recording("ride.mcap", sprung.load_system())
    >>> sum(len(block.time) for block in ride.blocks())
    56000
    """
    return open_stream(Path(path), system, database_of(system, Path(dbc) if dbc else None), start)


def load_record(path: str | Path, system: System, dbc: str | Path | None = None, start: int | None = None) -> Record:
    """A whole recording on one even grid, as `diagnose` wants it; arguments and errors as of `open_recording`.

    Columns are the system's channels, then the `signals` of its file, which parameters of components may follow.

    >>> import sprung
    >>> record = sprung.load_record("ride.mcap", sprung.load_system())
    >>> record.values.shape, record.sample_rate, record.lost
    ((2000, 28), 100.0, 0)
    """
    return open_record(Path(path), system, database_of(system, Path(dbc) if dbc else None), start, signals=True)


def simulate(
    system: System, inputs: FloatArray, parameters: Mapping[str, float] | None = None, start: FloatArray | None = None
) -> FloatArray:
    """What the sensors of a system would show, with the laws of its file and noise-free, shape (T, S).

    inputs: measured inputs in the order of `system.inputs`, shape (T, I), sampled at `system.sample_rate`.
    parameters: values that differ from nominal, by name, in SI units.
    start: state at the first sample (displacements, then rates), shape (N,); at rest by default.
    Errors: `SimulationError`.

    >>> import numpy as np, sprung
    >>> system = sprung.load_system()
    >>> time = np.arange(400) / system.sample_rate
    >>> inputs = np.zeros((400, len(system.inputs)))
    >>> inputs[:, 0::2] = (1e-3 * np.sin(2 * np.pi * 1.1 * time))[:, None]
    >>> inputs[:, 1::2] = np.gradient(inputs[:, 0::2], 0.01, axis=0)
    >>> sensors = sprung.simulate(system, inputs, {"secondary_1l.damping": 10e3})
    >>> sensors.shape
    (400, 12)
    """
    return simulate_ride(system, inputs, parameters, start).sensors


def identify(
    system: System, values: FloatArray | Mapping[str, FloatArray], model: Identifies | None = None
) -> IdentifiedWindow:
    """Stiffness and damping of every element from one window.

    values: shape (T, C) in the order of `system.channels`, or one array per channel name; an absent channel is
    NaN or left out.
    model: `load_identifier(system, folder)` for weights of your own; the bundled ones, or the nominal start, otherwise.
    Errors: `UnusableWindow`, also for a window that has no values, as one without any input.

    >>> import numpy as np, sprung
    >>> system = sprung.load_system()
    >>> rng = np.random.default_rng(1)
    >>> speed = rng.normal(0, 0.02, (100, 8)).cumsum(axis=0) * 0.1
    >>> inputs = np.empty((100, 16))
    >>> inputs[:, 1::2] = speed
    >>> inputs[:, 0::2] = speed.cumsum(axis=0) / system.sample_rate
    >>> sensors = sprung.simulate(system, inputs, {"primary_11l.stiffness": 1.0e6})
    >>> window = sprung.identify(system, np.concatenate([inputs, sensors], axis=1))
    >>> abs(window["primary_11l.stiffness"].value - 1.0e6) < 3 * window["primary_11l.stiffness"].std
    True
    """
    window = _window(system, values)
    estimate = (model or load_identifier(system)).identify(window[None])[0]
    if not estimate.identified:
        raise UnusableWindow(f"{system.name}: {estimate.reason}")
    return IdentifiedWindow(_values(system, estimate), estimate)


def track(system: System, recording: Recording, model: Identifies | None = None) -> Tracked:
    """Posterior, drift and alarms of every parameter over a whole recording, as the service follows a vehicle.

    >>> import sprung
    >>> system = sprung.load_system()
    >>> tracked = sprung.track(system, sprung.open_recording("ride.mcap", system))
    >>> spring = tracked.parameters[0]
    >>> spring.name, spring.identifiable, abs(spring.ratio - 1) < 0.05
    ('primary_11l.stiffness', True, True)
    """
    engine = Engine(system, model or load_identifier(system), make_tracker(system))
    followed, count = FollowedVehicle(engine.tracker.initial_state()), 0
    for windows in _cut(system, recording):
        whole = [window for window in windows if window.outcome != "dropped"]
        estimates: Iterator[Estimate] = iter(())
        if whole:
            known = [engine.tracker.known_faults(followed.state)] * len(whole)
            values, starts = np.stack([w.values for w in whole]), [w.start for w in whole]
            found, _ = engine.identify(values, starts=starts, known=known)
            estimates = iter(found)
        for window in windows:
            estimate = None if window.outcome == "dropped" else next(estimates)
            conditions = system.conditions(window.auxiliary)
            followed = followed.after(engine.tracker, window, estimate, now_ns(), conditions)
        count += len(whole)
    state = followed.state
    return Tracked(engine.tracker.report(state), state.alarms, engine.tracker.health(state), count)


def _cut(system: System, recording: Recording) -> Iterator[list[Window]]:
    """Windows in batches, in order of time."""
    windower = windower_of(system, recording.stamped)
    held: list[Window] = []
    beside = AuxiliaryMeans(len(system.channels), len(system.auxiliary))
    for block in recording.at_rate(system.sample_rate, beside.keep):
        held += map(beside.to, windower.push(block))
        while len(held) >= AT_ONCE:
            yield held[:AT_ONCE]
            held = held[AT_ONCE:]
    held += map(beside.to, windower.flush())
    for first in range(0, len(held), AT_ONCE):
        yield held[first : first + AT_ONCE]


def _window(system: System, values: FloatArray | Mapping[str, FloatArray]) -> FloatArray:
    if not isinstance(values, Mapping):
        return np.asarray(values, dtype=np.float64)
    names = [channel.name for channel in system.channels]
    unknown = sorted(set(values) - set(names))
    if unknown:
        raise UnusableWindow(f"{unknown[0]}: no such channel; there are {', '.join(names)}")
    lengths = {name: len(column) for name, column in values.items()}
    if len(set(lengths.values())) != 1:
        raise UnusableWindow(f"channels differ in length: {lengths}")
    absent = np.full(next(iter(lengths.values())), np.nan)
    return np.stack([np.asarray(values.get(name, absent), dtype=np.float64) for name in names], axis=1)


def _values(system: System, estimate: Estimate) -> tuple[ParameterValue, ...]:
    std = np.sqrt(np.diag(estimate.covariance))
    return tuple(
        ParameterValue(
            p.name, p.nominal * float(np.exp(x)), p.nominal * float(np.exp(x) * s), p.unit, p.nominal, bool(i)
        )
        for p, x, s, i in zip(system.tracked, estimate.log_ratio, std, estimate.identifiable, strict=True)
    )
