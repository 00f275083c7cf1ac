"""Detection of component tests and their signals: elements between supports and ground.

The motion is measured at both ends and the force by a load cell, so that no simulation is needed.  Bodies that hardly
move under the measured force, such as the frame of a test bench, are treated as ground.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.component.given import given_model
from sprung.model.diagnosis.component.integrated import integrated, without_slow
from sprung.model.diagnosis.component.own import observed, own_pieces
from sprung.model.diagnosis.component.spikes import WrongValues, without_wrong_values
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentModel, ComponentTask, NominalValues
from sprung.model.diagnosis.force.motion import (
    element_motion,
    noise_at_rest,
    still_stretches,
    without_gaps,
)
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.record.channels import DiagnosisError, TooLittleError
from sprung.model.diagnosis.record.white_noise import white_noise, without_motion
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.laws import Law, SpringDamper
from sprung.model.laws.following import Covariate
from sprung.model.schema import GROUND, ElementSensor, Sensor, SupportInput
from sprung.model.signals import FloatArray
from sprung.model.system import System

_TOLD = 5  # times of wrong values that are listed


@dataclass(frozen=True)
class ComponentRecord:
    """One component on one recording."""

    element: str
    sensor: str
    task: ComponentTask
    notes: tuple[str, ...]
    given: ComponentModel = NO_LAWS  # laws of the system file
    own: tuple[Piece, ...] = ()  # user-defined laws of the search
    left_out: tuple[str, ...] = ()  # wrong values of the channels, in words


@dataclass(frozen=True)
class _Wandering:
    """Errors of integrated motions."""

    deflection: float = 0.0  # m, noise
    rate: float = 0.0  # m/s, noise
    lowest: float = 0.0  # Hz, edge of the high-pass filter

    def beside(self, other: _Wandering) -> _Wandering:
        """Errors of the difference of two motions."""
        noise = float(np.hypot(self.deflection, other.deflection)), float(np.hypot(self.rate, other.rate))
        return _Wandering(*noise, max(self.lowest, other.lowest))


def is_component_test(system: System, values: FloatArray, rules: Rules = RULES) -> bool:
    """Whether no simulation is needed: there are no bodies, or the measured forces hardly move them.

    values: (T, C), columns of a recording.  A foundation in the model of a test bench counts as ground if its motion
    under the measured force, by its stiffness and mass, is negligible compared with that of the rod.
    """
    if not system.bodies:
        return True
    names = [channel.name for channel in system.channels]
    if any(not isinstance(source, SupportInput) for source in system.file.inputs.values()):
        return False
    weighed = component_elements(system, set())
    if set(system.sensors) - set(weighed.values()) or not weighed:
        return False
    moved = [_spread(values, names, f"{n}.displacement") for n in system.file.inputs if f"{n}.displacement" in names]
    if not moved or min(moved) == 0:
        return False
    force = sum(_spread(values, names, sensor) for sensor in weighed.values())
    least = min(_stiffness_to_ground(system, weighed).values())
    return least > 0 and force / least < rules.component.frame * min(moved)


def _spread(values: FloatArray, names: list[str], name: str) -> float:
    """Standard deviation of a channel."""
    return float(np.nanstd(values[:, names.index(name)]))


def _stiffness_to_ground(system: System, without: Container[str]) -> dict[str, float]:
    """Stiffness, N/m, of the elements that hold every body to ground, except those named in `without`."""
    held = dict.fromkeys(system.bodies, 0.0)
    for name, element in system.file.elements.items():
        ends = {element.upper, element.lower}
        if name not in without and GROUND in ends:
            for body in ends & held.keys():
                held[body] += element.stiffness.value
    return held


def component_elements(system: System, held: set[str]) -> dict[str, str]:
    """Force sensors by the element whose ends are not among the given bodies."""
    return {
        sensor.element: name
        for name, sensor in system.file.sensors.items()
        if isinstance(sensor, ElementSensor)
        and sensor.kind == "force"
        and not {system.file.elements[sensor.element].upper, system.file.elements[sensor.element].lower} & held
    }


def component_records(
    system: System,
    values: FloatArray,
    sample_rate: float,
    rules: Rules = RULES,
    laws: tuple[Law, ...] = (),
) -> list[ComponentRecord]:
    """The component tests in a recording's columns (T, C), in the order of `system.channels`.

    laws: searched beside those of the catalogue.
    Errors: `DiagnosisError` for a missing channel, `TooLittleError` for too short or motionless recordings.
    """
    elements = component_elements(system, set())
    if not elements:
        raise DiagnosisError(
            "a system without bodies is a component test: it needs an element between a support and ground (or two "
            "supports) and a sensor {kind: force, element: ...} on it"
        )
    channels = {element: _channels(system, element, sensor) for element, sensor in elements.items()}
    values, wrong = _mended(system, values, dict.fromkeys(name for names in channels.values() for name in names))
    records = []
    for element, sensor in elements.items():
        record = _record(system, values, sample_rate, element, sensor, rules, laws)
        told = _left_out({name: wrong[name] for name in channels[element]}, sample_rate)
        records.append(replace(record, left_out=told))
    return records


def _channels(system: System, element: str, sensor: str) -> list[str]:
    """Channels of a component test: its force, and the motion of its ends."""
    names, ends = [channel.name for channel in system.channels], system.file.elements[element]
    moved = {ends.upper, ends.lower} & set(system.file.inputs)
    return [sensor, *(name for name in names if name.split(".")[0] in moved)]


def _mended(system: System, values: FloatArray, channels: Iterable[str]) -> tuple[FloatArray, dict[str, WrongValues]]:
    """Columns (T, C) without wrong values of these channels, and by channel where these were."""
    names, mended, wrong = [channel.name for channel in system.channels], np.array(values, dtype=float), {}
    for name in channels:
        at = names.index(name)
        mended[:, at], wrong[name] = without_wrong_values(mended[:, at])
    return mended, wrong


def _record(
    system: System,
    values: FloatArray,
    sample_rate: float,
    element: str,
    sensor: str,
    rules: Rules,
    laws: tuple[Law, ...],
) -> ComponentRecord:
    """One component test.  Errors: as `component_records`."""
    notes: list[str] = []
    measured = _measured(system, values, sample_rate, element, sensor, rules, notes)
    rests = still_stretches(measured.displacement, sample_rate, rules)
    run = _between(rests, len(measured.force), rules.record.minimum_samples)
    if run != slice(0, len(measured.force)):
        notes.append(
            f"{element} stands still before {run.start / sample_rate:.2f} s and after {run.stop / sample_rate:.2f} s: "
            "cut out; the force's noise was measured there"
        )
    velocity = None if measured.velocity is None else measured.velocity[run]
    begin = (measured.first + run.start) / sample_rate
    motion = element_motion(measured.displacement[run], velocity, sample_rate, begin, rules)
    stated = system.file.elements[element]
    sizes = observed(motion, SpringDamper(stated.stiffness.value, stated.damping.value))
    given, held = given_model(system, element, sizes, notes)
    own = own_pieces(laws, element, sizes, notes)
    force = measured.force[run]
    noise, at_rest = _noise(measured, rests, run, system.file.sensors[sensor], rules)
    task = ComponentTask(
        motion=motion.with_noise(measured.errors.deflection, measured.errors.rate),
        force=force,
        split=int(rules.record.fitted * (run.stop - run.start)),
        nominal=NominalValues(*(_fixed(system, element, q) for q in ("stiffness", "damping"))),
        rules=rules.component,
        signals=covariates(system, values, sample_rate, element, notes),
        noise=noise,
        least_noise=at_rest,
        declared=system.file.sensors[sensor].noise,
        held=held,
        delay_std=min(_delay_std(system, sensor), 1 / sample_rate),
    )
    return ComponentRecord(element, sensor, task, tuple(notes), given, own)


def _left_out(wrong: Mapping[str, WrongValues], sample_rate: float) -> tuple[str, ...]:
    """Wrong values that were left out, in words; by channel."""
    told = []
    for name, values in wrong.items():
        if len(values.at):
            few, times = len(values.at) == 1, _times(values.at.tolist(), sample_rate)
            one, some = (
                ("a single value", "single values") if values.width == 1 else ("a pair of values", "pairs of values")
            )
            what = one if few else f"{len(values.at)} {some}"
            stand, were = ("stands", "was") if few else ("stand", "were")
            told.append(f"{name}: {what}, at {times}, {stand} out from all other changes and {were} left out")
        if values.dropouts:
            times = _times([run.start for run in values.dropouts], sample_rate)
            told.append(f"{name} drops out, at {times}: what it repeats there was left out")
    return tuple(told)


def _times(at: Sequence[int], sample_rate: float) -> str:
    """The first of some samples' times, in words."""
    more = " and later" if len(at) > _TOLD else ""
    return ", ".join(f"{index / sample_rate:.2f}" for index in at[:_TOLD]) + f" s{more}"


def _noise(measured: _Measured, rests: list[slice], run: slice, cell: Sensor, rules: Rules) -> tuple[float, float]:
    """Noise of a load cell that the record shows at standstill or in its fastest changes, N, and the former alone.

    Friction and stops change a force as fast as noise does: where the file declares the noise, it is no larger than
    declarations are wrong by.
    """
    force = without_motion(measured.force[run], measured.displacement[run], rules.white_noise)
    at_rest = noise_at_rest(measured.force, rests) or 0.0
    most = rules.noise.misdeclared * cell.noise if cell.noise > 0 else np.inf
    return min(max(at_rest, white_noise(force, rules.white_noise)), most), min(at_rest, most)


@dataclass(frozen=True)
class _Measured:
    """The longest gap-free stretch of a component test."""

    displacement: FloatArray  # m, (T,)
    velocity: FloatArray | None  # m/s, (T,), if measured
    force: FloatArray  # N, (T,)
    errors: _Wandering  # of an integrated motion
    first: int  # its first sample in the recording


def _measured(
    system: System,
    values: FloatArray,
    sample_rate: float,
    element: str,
    sensor: str,
    rules: Rules,
    notes: list[str],
) -> _Measured:
    """Motion and force of an element.  Errors: as `component_records`."""
    names = [channel.name for channel in (*system.channels, *system.signals)]
    displacement, velocity, errors = _deflection(system, element, values, names, sample_rate, rules, notes)
    force = _column(values, names, sensor)
    if errors.lowest > 0:
        force = without_slow(force, sample_rate, errors.lowest)
    good = np.isfinite(displacement) & np.isfinite(force) & (True if velocity is None else np.isfinite(velocity))
    first, last = _longest(good, max(1, int(rules.record.gap * sample_rate)))
    if last - first < rules.record.minimum_samples:
        raise TooLittleError(
            f"too short to decide anything: {element} has {last - first} usable samples in a row; "
            f"at least {rules.record.minimum_samples} are needed"
        )
    if last - first < len(values):
        notes.append(f"used {first / sample_rate:.2f} s to {last / sample_rate:.2f} s of the recording")
    d, f = (without_gaps(series[first:last]) for series in (displacement, force))
    v = None if velocity is None else without_gaps(velocity[first:last])
    if np.std(d) <= rules.component.moves * white_noise(d, rules.white_noise) or np.ptp(d) == 0:
        raise TooLittleError(f"too still to decide anything: {element} is not moved")
    if np.ptp(f) == 0:
        raise DiagnosisError(f"sensor {sensor} is stuck: it repeats one value; the test cannot be evaluated without it")
    return _Measured(d, v, f, errors, first)


def _delay_std(system: System, sensor: str) -> float:
    """Standard deviation of a channel's delay in the data sheet, s."""
    names = [channel.name for channel in system.channels][-len(system.tolerances) :]
    return float(system.tolerances[names.index(sensor)].delay)


def _deflection(
    system: System,
    element: str,
    values: FloatArray,
    names: list[str],
    sample_rate: float,
    rules: Rules,
    notes: list[str],
) -> tuple[FloatArray, FloatArray | None, _Wandering]:
    """Deflection of an element (T,), upper less lower end; its rate if known at both ends; errors of integration."""
    ends, count = system.file.elements[element], len(values)
    displacement, velocity, has_velocity, left = np.zeros(count), np.zeros(count), True, _Wandering()
    for end, sign in ((ends.upper, 1.0), (ends.lower, -1.0)):
        if end not in system.file.inputs:
            if end != GROUND:
                notes.append(f"{end} hardly moves under the measured force and is treated as ground")
            continue
        moved, rate, more = _motion_of(system, end, values, names, sample_rate, rules, notes)
        left = left.beside(more)
        displacement += sign * moved
        has_velocity &= rate is not None
        velocity += sign * (rate if rate is not None else 0.0)
    return displacement, velocity if has_velocity else None, left


def _between(rests: list[slice], count: int, least: int) -> slice:
    """The samples between standstill at both ends of `count` samples; all of them if too few are left."""
    start = rests[0].stop if rests and rests[0].start == 0 else 0
    stop = rests[-1].start if rests and rests[-1].stop == count else count
    return slice(start, stop) if stop - start >= least else slice(0, count)


def _motion_of(
    system: System,
    end: str,
    values: FloatArray,
    names: list[str],
    sample_rate: float,
    rules: Rules,
    notes: list[str],
) -> tuple[FloatArray, FloatArray | None, _Wandering]:
    """Displacement of a support (T,), its rate if known, and errors of integration."""
    source, nothing = system.file.inputs[end], _Wandering()
    if not isinstance(source, SupportInput):
        raise DiagnosisError(f"input {end}: a component test needs its motion measured, not a force on it")
    rate = _column(values, names, f"{end}.velocity") if "velocity" in source.measured else None
    if "displacement" in source.measured:
        return _column(values, names, f"{end}.displacement"), rate, nothing
    if rate is not None:
        notes.append(f"{end}.displacement was integrated from its velocity")
        return _integral(rate, sample_rate), rate, nothing
    moved = integrated(_column(values, names, f"{end}.acceleration"), sample_rate, rules)
    if moved is None:
        raise TooLittleError(f"too still to decide anything: {end}.acceleration contains nothing but noise")
    notes.append(
        f"{end}'s motion was integrated from its acceleration; below {moved.lowest:.2g} Hz it is not known, and "
        "nothing is said of the force there, nor of a preload"
    )
    return moved.displacement, moved.velocity, _Wandering(moved.displacement_noise, moved.velocity_noise, moved.lowest)


def covariates(
    system: System, values: FloatArray, sample_rate: float, element: str, notes: list[str]
) -> tuple[Covariate, ...]:
    """Signals on which an element may depend, if a recording (T, C) has them; `notes` lists the missing ones."""
    found = []
    first = len(system.channels)
    for index, channel in enumerate(system.signals):
        if channel.name not in system.file.elements[element].depends_on:
            continue
        series = values[:, first + index] if first + index < values.shape[1] else np.full(len(values), np.nan)
        signal = Covariate.of(channel.name, channel.unit, series, sample_rate)
        if not np.isfinite(series).any():
            notes.append(f"{channel.name} is not in this recording: dependence on it cannot be identified")
        elif signal is None:
            notes.append(f"{channel.name} does not change in this recording: dependence on it cannot be identified")
        else:
            found.append(signal)
    return tuple(found)


def _fixed(system: System, element: str, quantity: str) -> float | None:
    """The value fixed by the system file; None: to be estimated."""
    value = getattr(system.file.elements[element], quantity)
    free = quantity in system.file.estimate and not value.fixed
    return None if free else float(value.value)


def _column(values: FloatArray, names: list[str], name: str) -> FloatArray:
    series = np.array(values[:, names.index(name)], dtype=float)
    if not np.isfinite(series).any():
        raise DiagnosisError(f"channel {name} has no data in the recording")
    return series


def _integral(rate: FloatArray, sample_rate: float) -> FloatArray:
    """A position by integration of its rate, without its mean; gaps are kept."""
    good = np.isfinite(rate)
    filled = without_gaps(rate)
    position = np.concatenate([[0.0], np.cumsum(0.5 * (filled[1:] + filled[:-1]))]) / sample_rate
    return np.where(good, position - position.mean(), np.nan)


def _longest(good: np.ndarray, gap: int) -> tuple[int, int]:
    """The longest run of samples without a gap longer than `gap` samples."""
    at = np.flatnonzero(good)
    if not len(at):
        return 0, 0
    breaks = np.flatnonzero(np.diff(at) > gap + 1)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(at) - 1]])
    best = int(np.argmax(at[ends] - at[starts]))
    return int(at[starts[best]]), int(at[ends[best]]) + 1


def turned_round(task: ComponentTask) -> bool:
    """Whether the force has the wrong sign: the component would have negative damping or stiffness.

    Values that the system file fixes are not considered.
    """
    d = task.motion.deflection - np.mean(task.motion.deflection)
    columns = np.column_stack([np.ones(len(d)), d, task.motion.rate])[: task.split]
    force = task.force[: task.split]
    solved = np.linalg.lstsq(columns, force, rcond=None)[0]
    with_sign = solved[1] * float(np.std(d)), solved[2] * float(np.std(task.motion.rate))
    found: bool = sum(with_sign) < 0 and abs(min(with_sign)) > task.rules.turned * max(*with_sign, 0.0)
    return found
