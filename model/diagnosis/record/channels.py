"""Signals from the columns of a recording: gaps closed, stuck and missing channels reported."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from sprung.model.diagnosis.record.fused import FusedMotion
from sprung.model.diagnosis.record.highpass import carries_everything, passed
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.record.slower import slower, slower_by
from sprung.model.diagnosis.record.stretch import at_rest, liveliest, standstill
from sprung.model.diagnosis.rules import RULES, RecordRules
from sprung.model.mechanics import ACCELERATION
from sprung.model.schema import ForceInput, SupportInput, TrackInput
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import ORDERS
from sprung.model.system import System


class DiagnosisError(ValueError):
    """The recording cannot be diagnosed; the message says what is missing and what to do."""


class TooLittleError(DiagnosisError):
    """The recording is valid, but too short or too still to decide anything."""


@dataclass(frozen=True)
class Prepared:
    """Signals, and faults of the channels."""

    signals: Signals
    stuck: tuple[tuple[str, float], ...]  # channel, s from the start of the recording at which it froze
    notes: tuple[str, ...]
    used: str = ""  # the diagnosed stretch in words, if not the whole recording


def prepare(system: System, values: FloatArray, sample_rate: float, rules: RecordRules = RULES.record) -> Prepared:
    """Signals by role from columns (T, C) in the order of `system.channels`.

    Errors: `DiagnosisError` if an input is missing, `TooLittleError` for too short or motionless recordings.
    """
    names = [channel.name for channel in system.channels]
    if values.ndim != 2 or values.shape[1] != len(names):
        raise DiagnosisError(f"values: expected shape (samples, {len(names)}), came {values.shape}")
    values = np.array(values, dtype=float)
    notes: list[str] = []
    stuck = _blank_unusable(system, values, names, sample_rate, notes, rules)
    first, last = _long_enough(values, sample_rate, notes, rules)
    values, begin, factor = _slowed(system, _close_gaps(values[first:last]), sample_rate, rules)
    if factor > 1:
        notes.append(
            f"diagnosed at {sample_rate / factor:g} Hz instead of {sample_rate:g} Hz, behind a linear-phase filter: "
            "at higher frequencies the sensors show nothing but noise"
        )
    begin, sample_rate = first / sample_rate + begin, sample_rate / factor
    start, stop, used = _affordable(system, values, sample_rate, begin, rules)
    values, begin = values[start:stop], begin + start / sample_rate
    prepared = _by_role(system, values, sample_rate, tuple(stuck), notes, begin, rules)
    signals = _above_drift(system, replace(prepared.signals, averaged=factor), notes, rules)
    _require_motion(system, signals, rules)
    return replace(prepared, signals=signals, notes=tuple(notes), used=used)


def _blank_unusable(
    system: System, values: FloatArray, names: list[str], sample_rate: float, notes: list[str], rules: RecordRules
) -> list[tuple[str, float]]:
    """Sets standstill and stuck channels in the columns (T, C) to NaN; the stuck channels with their times, s."""
    resting = {n for n, s in system.file.inputs.items() if s.kind == "force" and not np.any(values[:, names.index(n)])}
    notes += [
        f"input {name} is zero throughout: treated as no force" for name in sorted(resting) if _recorded(system, name)
    ]
    still = standstill(values, max(int(sample_rate), rules.stuck_samples), rules.resting)
    if all(isinstance(source, SupportInput) for source in system.file.inputs.values()):  # no blow ends a rest
        noise = np.array([channel.noise for channel in system.channels])
        still |= at_rest(values, rules.moves * noise, max(int(rules.rest * sample_rate), rules.stuck_samples))
    if still.any() and not still.all():
        values[still] = np.nan
        notes.append(
            f"standstill of {still.sum() / sample_rate:.1f} s is left out; the longest stretch that moves is used"
        )
    steady = {"speed"} if system.on_track else set()  # may be constant for minutes
    return _blank_stuck(values, names, sample_rate, resting | steady, rules)


def _long_enough(values: FloatArray, sample_rate: float, notes: list[str], rules: RecordRules) -> tuple[int, int]:
    """First and last sample of the longest usable stretch.  Errors: `TooLittleError` if it is too short."""
    first, last = _usable_stretch(values, max(1, int(rules.gap * sample_rate)))
    if last - first < rules.minimum_samples:
        raise TooLittleError(
            f"too short to decide anything: the recording has {last - first} usable samples in a row; "
            f"at least {rules.minimum_samples} ({rules.minimum_samples / sample_rate:.1f} s) are needed"
        )
    if last - first < len(values):
        notes.append(
            f"used {first / sample_rate:.2f} s to {last / sample_rate:.2f} s of the recording, the longest stretch "
            "without standstill and gaps too long to close"
        )
    return first, last


def _above_drift(system: System, signals: Signals, notes: list[str], rules: RecordRules) -> Signals:
    """Signals without the drift of supports that are measured by acceleration alone.

    Errors: `TooLittleError` if too little is left.
    """
    filtered, cutoff = passed(system, signals, rules)
    if cutoff:
        end = filtered.start + filtered.samples / filtered.sample_rate
        notes.append(
            f"supports measured by accelerations alone: all signals are compared above {cutoff:.2g} Hz, "
            f"{filtered.start:.1f} s to {end:.1f} s of the recording"
        )
        if filtered.samples < rules.minimum_samples:
            raise TooLittleError(
                f"too short to decide anything: {signals.samples / signals.sample_rate:.1f} s, of which "
                f"{rules.settled / cutoff:.1f} s at either end are lost to accelerations that must be integrated"
            )
    return filtered


def _slowed(
    system: System, values: FloatArray, sample_rate: float, rules: RecordRules
) -> tuple[FloatArray, float, int]:
    """Columns at a lower rate if that loses nothing, the time of their first sample, s, and the reduction factor."""
    factor = slower_by(system, values, sample_rate, rules)
    if factor == 1:
        return values, 0.0, factor
    values, begin = slower(values, factor)
    return values, begin / sample_rate, factor


def _affordable(
    system: System, values: FloatArray, sample_rate: float, begin: float, rules: RecordRules
) -> tuple[int, int, str]:
    """First and last sample of gap-free columns (T, C) that are diagnosed, and the stretch in words.

    begin: time of their first sample, s.
    """
    if len(values) <= rules.longest:
        return 0, len(values), ""
    sensors = values[:, len(system.inputs) :]
    present = np.isfinite(sensors).any(axis=0)
    start, stop = liveliest(sensors[:, present], rules.longest, rules.shock)
    used = (
        f"{begin + start / sample_rate:.0f} s to {begin + stop / sample_rate:.0f} s of the recording, which has "
        f"{len(values) / sample_rate:.0f} s that can be used, were diagnosed, where the sensors move most: memory and "
        "time grow with the length, and the rest would only make the same values slightly more precise"
    )
    return start, stop, used


def _recorded(system: System, name: str) -> bool:
    """Whether a force has an address in recordings."""
    source = system.file.inputs[name]
    return isinstance(source, ForceInput) and any((source.mcap, source.can, source.csv, source.column))


def _require_motion(system: System, signals: Signals, rules: RecordRules) -> None:
    listed = list(system.file.sensors.values())
    noise = np.array([listed[index].noise for index in signals.sensor_index])
    moves = np.std(signals.sensors, axis=0)
    if np.all(moves < rules.moves * noise):
        best = int(np.argmax(moves / noise))
        raise TooLittleError(
            f"too still to decide anything: no sensor moves by {rules.moves:g} times its noise "
            f"({signals.sensor_names[best]}: {moves[best]:.2g}, noise {noise[best]:.2g}); "
            "record faster or on rougher track"
        )


def _blank_stuck(
    values: FloatArray, names: list[str], sample_rate: float, resting: set[str], rules: RecordRules
) -> list[tuple[str, float]]:
    """Columns that repeat one value for a share of the recording become NaN, except resting ones; these columns."""
    found = []
    for column, name in enumerate(names):
        series = values[:, column]
        good = np.flatnonzero(np.isfinite(series))
        if len(good) < 2 or name in resting:
            continue
        change = np.flatnonzero(np.diff(series[good]) != 0)
        edges = np.concatenate([[-1], change, [len(good) - 1]])
        runs = np.diff(edges)
        longest = int(np.argmax(runs))
        if runs[longest] >= max(sample_rate, rules.stuck * len(values), rules.stuck_samples):
            found.append((name, float(good[edges[longest] + 1] / sample_rate)))
            values[:, column] = np.nan
    return found


def _usable_stretch(values: FloatArray, longest_gap: int) -> tuple[int, int]:
    """Longest run of samples in which every channel that is present at all has no long gap."""
    present = np.isfinite(values).any(axis=0)
    bad = np.zeros(len(values), dtype=bool)
    for column in np.flatnonzero(present):
        missing = ~np.isfinite(values[:, column])
        edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(int), [0]])))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if stop - start > longest_gap or start == 0 or stop == len(values):
                bad[start:stop] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[1], bad.astype(int), [1]])))
    runs = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return max(runs, key=lambda run: run[1] - run[0], default=(0, 0))


def _close_gaps(values: FloatArray) -> FloatArray:
    """Short gaps by cubic interpolation through their neighbours."""
    for column in range(values.shape[1]):
        missing = ~np.isfinite(values[:, column])
        if missing.any() and not missing.all():
            good = np.flatnonzero(~missing)
            values[missing, column] = CubicSpline(good, values[good, column])(np.flatnonzero(missing))
    return values


@dataclass(frozen=True)
class _Inputs:
    """Measured inputs by role."""

    displacement: list[FloatArray]
    velocity: list[FloatArray]
    force: list[FloatArray]
    integrated: list[bool]
    accelerated: list[bool]
    support_names: list[str]
    force_names: list[str]
    fused: list[FusedMotion]
    levelled: FloatArray | None  # acceleration of a support that is its only measurement


def _inputs(system: System, values: FloatArray, dt: float, frozen: set[str], notes: list[str]) -> _Inputs:
    """Inputs from the columns (T, C) of a recording.  Errors: `DiagnosisError` when one is missing."""
    found = _Inputs([], [], [], [], [], [], [], [], None)
    column, missing = 0, list[str]()
    for name, source in system.file.inputs.items():
        if isinstance(source, TrackInput):  # not measured
            continue
        quantities = list(source.measured) if isinstance(source, SupportInput) else [""]
        there = {q: values[:, column + i] for i, q in enumerate(quantities) if not np.isnan(values[0, column + i])}
        column += len(quantities)
        if not there:
            missing.append(name)
            continue
        if not isinstance(source, SupportInput):
            found.force.append(there[""])
            found.force_names.append(name)
            continue
        if set(there) == {"acceleration"} and carries_everything(system, name):
            found = replace(found, levelled=there["acceleration"])
        elif "displacement" not in there and "displacement" in quantities:
            notes.append(f"{name}.displacement is missing: integrated from its {next(iter(there))}")
        if "acceleration" in there and len(there) > 1:
            found.fused.append(_fused(source, there, len(found.displacement)))
        d, v = _moved(source, there, dt)
        found.displacement.append(d)
        found.velocity.append(v)
        found.integrated.append("displacement" not in there)
        found.accelerated.append("acceleration" in there)
        found.support_names.append(name)
    if missing:
        raise DiagnosisError(_missing(system, missing, frozen))
    return found


def _by_role(
    system: System,
    values: FloatArray,
    sample_rate: float,
    stuck: tuple[tuple[str, float], ...],
    notes: list[str],
    begin: float,
    rules: RecordRules,
) -> Prepared:
    frozen = {name for name, _ in stuck}
    inputs = _inputs(system, values, 1 / sample_rate, frozen, notes)
    sensors = values[:, len(system.inputs) :]
    present = np.isfinite(sensors).all(axis=0)
    if not present.any():
        raise DiagnosisError("no sensor of the system file has data in the recording")
    for name in np.array(system.sensors)[~present]:
        if name not in frozen:
            notes.append(f"sensor {name} is missing: diagnosed without it")
    mean = _known_mean_acceleration(system, inputs, len(sensors), 1 / sample_rate, rules)
    if mean is not None:
        sensors = _without_offsets(sensors, mean, system.mechanics.sensor_kind == ACCELERATION)
    empty = np.zeros((len(values), 0))
    signals = Signals(
        sample_rate=sample_rate,
        displacement=np.column_stack(inputs.displacement) if inputs.displacement else empty,
        velocity=np.column_stack(inputs.velocity) if inputs.velocity else empty,
        force=np.column_stack(inputs.force) if inputs.force else empty,
        sensors=sensors[:, present],
        sensor_index=np.flatnonzero(present),
        sensor_names=tuple(np.array(system.sensors)[present].tolist()),
        support_names=tuple(inputs.support_names),
        force_names=tuple(inputs.force_names),
        integrated=np.array(inputs.integrated, dtype=bool),
        accelerated=np.array(inputs.accelerated, dtype=bool),
        start=begin,
        speed=values[:, : len(system.inputs)] if system.on_track else empty,
        fused=tuple(inputs.fused),
    )
    return Prepared(signals, stuck, tuple(notes))


def _known_mean_acceleration(
    system: System, inputs: _Inputs, samples: int, dt: float, rules: RecordRules
) -> FloatArray | None:
    """An acceleration (T,) whose mean is that of all bodies; None where these may have any.

    Bodies follow a support that carries everything, and bounded motion has no mean acceleration.
    """
    if inputs.levelled is not None:
        return _second_derivative(inputs.displacement[0], inputs.levelled, dt)
    if inputs.force_names and not inputs.support_names and _held(system, rules):
        return np.zeros(samples)
    return None


def _held(system: System, rules: RecordRules) -> bool:
    """Whether springs hold every mode of a system."""
    return all(mode.frequency > rules.held for mode in system.mechanics.modes(system.bodies))


def _moved(source: SupportInput, measured: dict[str, FloatArray], dt: float) -> tuple[FloatArray, FloatArray]:
    """Displacement of a support, and its velocity if these two are measured (else NaN)."""
    apart = np.full(len(next(iter(measured.values()))), np.nan)
    if "displacement" in measured and "acceleration" not in measured:
        return measured["displacement"], measured.get("velocity", apart)
    d = _fused(source, measured, 0).displacement(dt)
    return d, measured.get("velocity", apart) if set(measured) == {"velocity"} else apart


def _fused(source: SupportInput, measured: dict[str, FloatArray], support: int) -> FusedMotion:
    series = {ORDERS[quantity]: one for quantity, one in measured.items()}
    return FusedMotion(support, series, {ORDERS[quantity]: source.measured[quantity].noise for quantity in measured})


def _without_offsets(sensors: FloatArray, base: FloatArray, accelerations: np.ndarray) -> FloatArray:
    """Sensors (T, S), accelerations with the mean of the support's acceleration (T,).

    A taper that vanishes with its slope at both ends takes the mean of a relative acceleration to some
    (2 pi / duration)^2 of the relative displacement: nothing.
    """
    taper = np.hanning(len(base))
    offset = taper @ (sensors - base[:, None]) / taper.sum()
    return np.where(accelerations, sensors - offset, sensors)


def _second_derivative(displacement: FloatArray, acceleration: FloatArray, dt: float) -> FloatArray:
    """A measured acceleration (T,), filtered as its double integral, the displacement (T,), was."""
    lost = np.mean(acceleration[1:-1] - np.diff(displacement, 2) / dt**2)
    return acceleration - lost


def _missing(system: System, names: list[str], frozen: set[str]) -> str:
    """Why a recording that lacks some inputs cannot be diagnosed, and what to do, in one line."""
    several = len(names) > 1
    which = f"input{'s' * several} {' and '.join(names) if len(names) < 3 else f'{names[0]} and {len(names) - 1} more'}"
    stuck = all(any(f.startswith(name) for f in frozen) for name in names)
    state = f"{'are' if several else 'is'} {'stuck' if stuck else 'missing from the recording'}"
    them = "them" if several else "it"
    supports = all(isinstance(system.file.inputs[name], SupportInput) for name in names)
    other = "; a vehicle below which nothing is measured needs inputs of kind track" if supports and not stuck else ""
    return f"{which} {state}: nothing can be simulated without {them}; record {them} again or repair the channel{other}"
