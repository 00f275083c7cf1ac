"""A system: its file, its mechanics, its channels and the parameters to estimate."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sprung.model.address import Address
from sprung.model.digest import digest_of, structure_of
from sprung.model.laws import CATALOGUE, ElementLaw, Law, SensorLaw
from sprung.model.laws.in_place import Follower, MechanicsWithLaws, all_in_place, is_linear, misplaced
from sprung.model.laws.placed import PlacedLaw, placed_laws
from sprung.model.laws.undone import is_modelled, undone
from sprung.model.mechanics import Mechanics, Mode, assemble
from sprung.model.parameters import LoadState, Parameter, Tolerance
from sprung.model.schema import (
    RUNNING,
    SI,
    FollowedSignal,
    ForceInput,
    SupportInput,
    SystemFile,
    SystemFileError,
    TrackInput,
)
from sprung.model.sensor_kinds import USUAL_NOISE, USUAL_ZERO
from sprung.model.signals import Channel, Conditions, FloatArray, TimeColumn
from sprung.model.systemfile import parse_system_file, read_system_file

BUNDLED = Path(__file__).parent / "systems"
MANCHESTER = BUNDLED / "manchester.yaml"
MANCHESTER_DBC = BUNDLED / "bogie.dbc"

GAIN_STD = 0.015  # of a channel whose data sheet is not quoted: 1 to 2 % for accelerometers with their electronics
DELAY_STD = 0.002  # s: filters, scheduling and clocks of nodes
AXLE_STD = 0.03  # of an axle's mass that the file states without a deviation: wheels wear, and new ones are put on
LOAD_STD = 0.15  # of the logarithm of a mass: a third more by passengers is two deviations
USUAL_SPEED = 30.0  # m/s, taken for curves where only the yaw rate is measured
POSSIBLE = {  # values of operating conditions where the file states no range; beyond, a probe is broken
    "temperature": (-70.0, 150.0),  # degC
    "speed": (-200.0, 200.0),  # m/s; the record of trains is 168, and an odometer may count backwards
}
ALONG = ("displacement", "velocity")  # quantities of a support that say where it is, as laws need
_HELD = 1e-3  # Hz, a slower mode is one that nothing holds, but for rounding
SHORTEST_TRACK = 10.0  # s, of a window of a vehicle with unmeasured wheels


def _channel(name: str, quantity: str, at: Address) -> Channel:
    gain, offset = at.conversion(SI[quantity])
    possible = at.range or POSSIBLE.get(quantity)
    return Channel(name, SI[quantity], at.noise, at.mcap, at.can, at.csv, at.column, gain, offset, possible)


def _signal_channel(name: str, at: FollowedSignal) -> Channel:
    gain = at.sign * (1.0 if at.scale is None else at.scale)
    unit = at.unit or "1"
    return Channel(name, unit, at.noise, at.mcap, at.can, at.csv, at.column, gain, at.sign * at.offset, at.range)


@dataclass(frozen=True)
class System:
    """A checked system.  Parameters are ordered element by element: all stiffnesses, all dampings, then masses.

    Those of linear laws come between dampings and masses, ratios of masses at the end.

    A body's mass parameter scales its mass and its inertias together (a load that is spread like the body).
    """

    file: SystemFile
    catalogue: tuple[Law, ...] = CATALOGUE
    whole: bool = False  # whether laws of bodies and of the structure are part of the mechanics; see `whole_system`
    as_drawn: bool = False  # whether bodies are as the file says, see `built`
    lost: frozenset[str] = frozenset()  # channels of inputs that are not measured for the time being

    def __reduce__(self) -> tuple[Callable[..., System], tuple[object, ...]]:
        """To another process goes the file: the bundled laws are there already, and functions do not travel."""
        return _again, (self.file, None if self.catalogue is CATALOGUE else self.catalogue, self.whole, self.lost)

    @cached_property
    def laws(self) -> tuple[PlacedLaw, ...]:
        """What is in place beyond the nominal structure."""
        return placed_laws(self.file, self.catalogue)[0]

    def undistorted(self, values: FloatArray, *, filtered: bool = False) -> FloatArray:
        """Recorded channels (..., T, C) without the faults of measurements that the file states.

        filtered: sensors stay behind their filters, for who models these: to undo a high-pass filter integrates.
        """
        laws = [one for one in self.laws if not (filtered and is_modelled(one, self.sensors))]
        return undone(values, [channel.name for channel in self.channels], laws, self.sample_rate)

    @property
    def name(self) -> str:
        return self.file.name

    @property
    def sample_rate(self) -> float:
        return self.file.sample_rate

    @property
    def window(self) -> int:
        return self.file.window

    @property
    def hop(self) -> int:
        """Samples between window starts; half a window by default."""
        return self.file.hop or max(1, self.file.window // 2)

    @cached_property
    def mechanics(self) -> Mechanics:
        return self._in_place.mechanics

    @property
    def followers(self) -> tuple[Follower, ...]:
        """What follows the values of linear laws, which are parameters of the whole system."""
        return self._in_place.followers

    @property
    def all_elements(self) -> tuple[str, ...]:
        """Names of the elements of the mechanics."""
        return (*self.elements, *self._in_place.added)

    @cached_property
    def _in_place(self) -> MechanicsWithLaws:
        nominal = assemble(self.file)
        return all_in_place(self.file, nominal, self.laws) if self.whole else MechanicsWithLaws(nominal)

    @cached_property
    def whole_system(self) -> System:
        """With the laws of bodies and of the structure in its mechanics, their values among its parameters.

        Their elements come after those of the file, their degrees of freedom after those of the bodies.  Errors:
        `model.laws.in_place.LawError`.
        """
        return self if self.whole else replace(self, whole=True)

    @cached_property
    def elements(self) -> tuple[str, ...]:
        return tuple(self.file.elements)

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return tuple(self.file.bodies)

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        return tuple(self.file.sensors)

    @cached_property
    def inputs(self) -> tuple[Channel, ...]:
        """Measured input signals, in the order of the file; a support's displacement, velocity, acceleration.

        Wheels on a track have none; the measured speed, where there is one, determines how late each of them is.
        """
        channels = []
        if self.on_track and self._speed_measured and self.file.speed is not None:
            channels.append(_channel("speed", "speed", self.file.speed))
        for name, source in self.file.inputs.items():
            if isinstance(source, ForceInput):
                channels.append(_channel(name, "force", source))
            elif isinstance(source, SupportInput):
                channels += [_channel(f"{name}.{q}", q, address) for q, address in source.measured.items()]
        return tuple(channels)

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """Every measured signal: the inputs, then the sensors; the columns of a window."""
        sensors = (_channel(name, sensor.kind, sensor) for name, sensor in self.file.sensors.items())
        return (*self.inputs, *sensors)

    @cached_property
    def auxiliary(self) -> tuple[Channel, ...]:
        """Measured signals of operating conditions: `speed`, those of `RUNNING`, and `BODY.pressure` of loads."""
        channels = []
        if self._speed_measured and not self.on_track and self.file.speed is not None:
            channels.append(_channel("speed", "speed", self.file.speed))
        for key in RUNNING:
            address = getattr(self.file, key)
            if address is not None:
                channels.append(_channel(key, key, address))
        for name, body in self.file.bodies.items():
            if body.load is not None and body.load.pressure is not None:
                channels.append(_channel(f"{name}.pressure", "pressure", body.load.pressure))
        return tuple(channels)

    def conditions(self, auxiliary: FloatArray | None) -> Conditions:
        """How the vehicle ran during a window, from its auxiliary values (A,); impossible ones are unknown."""
        measured = [] if auxiliary is None else auxiliary.tolist()
        values = {
            channel.name: value
            for channel, value in zip(self.auxiliary, measured, strict=False)
            if channel.range is None or channel.range[0] <= value <= channel.range[1]
        }
        speed = values.get("speed", math.nan)
        if self.file.speed is not None and self.file.speed.value is not None:
            speed = self.file.speed.value
        usual = speed if math.isfinite(speed) else USUAL_SPEED
        lateral = values.get("lateral_acceleration", math.nan)
        if not math.isfinite(lateral):
            lateral = usual * values.get("yaw_rate", math.nan)
        pressure = tuple(values.get(f"{load.body}.pressure", math.nan) for load in self.loads)
        return Conditions(speed, values.get("temperature", math.nan), lateral, pressure)

    @cached_property
    def signals(self) -> tuple[Channel, ...]:
        """Measured signals that parameters may follow; a diagnosis reads them after `channels`."""
        return tuple(_signal_channel(name, at) for name, at in self.file.signals.items())

    def without(self, channels: frozenset[str]) -> System:
        """The system while these channels of inputs are not measured."""
        return replace(self, lost=self.lost | channels)

    @cached_property
    def needed(self) -> tuple[frozenset[str], ...]:
        """Sets of channels of inputs, of each of which a window must contain one at least.

        Where signals superpose, the motion of one support can be separated from that of the others: one input is
        enough.  Laws act along deflections, so that every support must be measured, and not by its acceleration alone.
        A speed that is missing is estimated.
        """
        if self.on_track or not self.inputs:
            return ()
        if all(is_linear(placed) or isinstance(placed.law, SensorLaw) for placed in self.laws):
            return (frozenset(channel.name for channel in self.inputs),)
        sets = []
        for name, source in self.file.inputs.items():
            if isinstance(source, SupportInput):
                sets.append(frozenset(f"{name}.{quantity}" for quantity in source.measured if quantity in ALONG))
            else:
                sets.append(frozenset([name]))
        return tuple(sets)

    @cached_property
    def on_track(self) -> bool:
        """Whether it runs on an unmeasured track."""
        return any(isinstance(source, TrackInput) for source in self.file.inputs.values())

    @property
    def _speed_measured(self) -> bool:
        return self.file.speed is not None and self.file.speed.value is None

    @cached_property
    def time(self) -> TimeColumn:
        """Where tables keep the time."""
        return self.file.time.as_column()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        found = []
        for quantity in ("stiffness", "damping"):
            if quantity in self.file.estimate:
                for name, element in self.file.elements.items():
                    value = getattr(element, quantity)
                    if not value.fixed:
                        found.append(Parameter(f"{name}.{quantity}", name, quantity, SI[quantity], value.value))
        found += [follower.parameter for follower in self.followers if follower.element >= 0]
        if "mass" in self.file.estimate:
            for name, body in self.file.bodies.items():
                if not body.mass.fixed:
                    found.append(Parameter(f"{name}.mass", name, "mass", "kg", body.mass.value))
        found += [follower.parameter for follower in self.followers if follower.body >= 0]
        return tuple(found)

    @cached_property
    def tracked(self) -> tuple[Parameter, ...]:
        """What windows are asked for: the parameters, then positive values of element laws that are not fixed.

        Among the parameters are those values of laws of bodies and of the structure that something grows with a power
        of; where a mode acts, or a mass hangs, is held.
        """
        found = list(self.whole_system.parameters)
        for placed in self.laws:
            if isinstance(placed.law, ElementLaw):
                values = zip(placed.law.parameters, placed.names, placed.values, placed.fixed, strict=True)
                for spec, name, value, fixed in values:
                    if value > 0 and not fixed:
                        quantity = f"{placed.law.name}.{spec.name}"
                        found.append(Parameter(name, placed.location, quantity, spec.unit, value))
        return tuple(found)

    @cached_property
    def loads(self) -> tuple[LoadState, ...]:
        """Bodies that carry passengers or goods: those with `load`; else those that support no other body.

        A mass that is estimated, or fixed, is no load; nor is one without `load` that is only seen in proportion to
        the springs at it.
        """
        declared = [name for name, body in self.file.bodies.items() if body.load is not None]
        carrying = {element.lower for element in self.file.elements.values()}
        estimated = {p.element for p in self.parameters if p.quantity == "mass"}
        free = [name for name in self.bodies if name not in carrying and not self.file.bodies[name].mass.fixed]
        unscaled = without_scale(self.file, free)
        free = [name for name in free if name not in unscaled]
        return tuple(self._load(name, name in declared) for name in declared or free if name not in estimated)

    def _load(self, name: str, declared: bool) -> LoadState:
        body = self.file.bodies[name]
        mass, most = body.mass.value, None if body.load is None else body.load.max
        std = LOAD_STD if most is None else max(0.5 * np.log1p(most / mass), 0.05)
        least = None if body.load is None else body.load.min
        return LoadState(f"{name}.load", name, mass, declared, float(std), least, most)

    @cached_property
    def built(self) -> tuple[str, ...]:
        """Bodies whose constants windows determine beside what the file says, see `model.simulate.loading`.

        Those that carry others and roll or pitch, unless their mass is fixed or estimated; none where laws act.
        """
        if self.as_drawn or self.laws or self.on_track or not self.file.inputs:
            return ()
        described = {load.body for load in self.loads} | {p.element for p in self.parameters if p.quantity == "mass"}
        turning = {n: b for n, b in self.file.bodies.items() if b.roll_inertia or b.pitch_inertia}
        return tuple(name for name, body in turning.items() if name not in described and not body.mass.fixed)

    @cached_property
    def doubtful_masses(self) -> dict[str, float]:
        """Bodies with uncertain mass, with its relative standard deviation.

        Those for which the file states one, and axles: they stand on a support, carry another body and do not pitch;
        new wheels are heavier by several per cent than worn ones.  A mass that is a load, estimated or fixed is none.
        """
        described = {load.body for load in self.loads} | {p.element for p in self.parameters if p.quantity == "mass"}
        found = {}
        for name, body in self.file.bodies.items():
            mass = body.mass
            std = mass.std / mass.value if mass.std is not None else (AXLE_STD if self._is_axle(name) else 0.0)
            if std > 0 and not mass.fixed and name not in described:
                found[name] = float(std)
        return found

    def _is_axle(self, name: str) -> bool:
        if self.file.bodies[name].pitch_inertia is not None:
            return False
        supports = {n for n, source in self.file.inputs.items() if not isinstance(source, ForceInput)}
        ends = [{element.upper, element.lower} for element in self.file.elements.values()]
        beside = set().union(*(pair for pair in ends if name in pair)) - {name}
        return bool(beside & supports and beside & self.file.bodies.keys())

    @cached_property
    def tolerances(self) -> tuple[Tolerance, ...]:
        """What the data sheet of every channel leaves open."""
        addresses: list[tuple[str, Address]] = []  # with the quantity
        for source in self.file.inputs.values():
            if isinstance(source, ForceInput):
                addresses.append(("force", source))
            elif isinstance(source, SupportInput):
                addresses += source.measured.items()
        addresses += [(sensor.kind, sensor) for sensor in self.file.sensors.values()]
        return tuple(
            Tolerance(
                GAIN_STD if at.gain_std is None else at.gain_std,
                DELAY_STD if at.delay_std is None else at.delay_std,
                USUAL_ZERO[SI[quantity]] if at.offset_std is None else at.offset_std,
            )
            for quantity, at in addresses
        )

    @cached_property
    def nominal(self) -> FloatArray:
        """Nominal values of the parameters, shape (P,)."""
        return np.array([p.nominal for p in self.parameters])

    @cached_property
    def sensor_noise(self) -> FloatArray:
        """Standard deviation of one sample of every sensor, shape (S,); a usual instrument's where none is stated."""
        sensors = self.channels[len(self.inputs) :]
        return np.array([channel.noise or USUAL_NOISE[channel.unit] for channel in sensors])

    @cached_property
    def digest(self) -> str:
        """Hash of everything that the mechanics depends on; addresses and comments do not count."""
        return digest_of(self.file, self.on_track)

    @cached_property
    def structure(self) -> str:
        """Hash of what estimates depend on but for their uncertainty; values of files with the same are the same."""
        return structure_of(self.file)


def _again(file: SystemFile, catalogue: tuple[Law, ...] | None, whole: bool, lost: frozenset[str]) -> System:
    return System(file, CATALOGUE if catalogue is None else catalogue, whole=whole, lost=lost)


def load_system(path: str | Path = MANCHESTER, catalogue: tuple[Law, ...] = CATALOGUE) -> System:
    """Load and check a system file; the bundled Manchester vehicle by default.

    catalogue: the laws that the file may name; `model.laws.own.load_laws` adds laws of a user's own.

    Errors: `SystemFileError`, one line that names file, line and key, also when the sensors cannot observe the
    system whose parameters are to be estimated.

    >>> import sprung
    >>> system = sprung.load_system()
    >>> system.parameters[0].name, system.parameters[0].nominal, len(system.sensors)
    ('primary_11l.stiffness', 1220000.0, 12)
    """
    return checked(System(read_system_file(path), catalogue), str(path))


def parse_system(text: str, source: str = "system file", catalogue: tuple[Law, ...] = CATALOGUE) -> System:
    """The same from text.

    >>> import pathlib, sprung
    >>> system = sprung.parse_system(pathlib.Path("rig.yaml").read_text())
    >>> [(p.name, p.nominal, p.unit) for p in system.parameters]
    [('damper.stiffness', 40000.0, 'N/m'), ('damper.damping', 1500.0, 'N s/m')]
    """
    return checked(System(parse_system_file(text, source), catalogue), source)


def checked(system: System, source: str) -> System:
    """Refuse a system that the model cannot treat yet, and one whose sensors miss a whole mode: its parameters could
    not be identified from any record."""
    refused = [*placed_laws(system.file, system.catalogue)[1], *unsupported(system.file)]
    refused = refused or misplaced(system.file, system.mechanics, system.laws)
    if refused:
        raise SystemFileError(f"{source}: {'; '.join(refused)}", tuple(f"{source}: {line}" for line in refused))
    if not system.parameters or not system.bodies:
        return system
    hidden = system.mechanics.unobservable_mode(system.bodies)
    if hidden is not None:
        raise SystemFileError(f"{source}: sensors: {_unseen(hidden)}")
    return system


def _unseen(mode: Mode) -> str:
    """That no sensor sees a mode, and what to do about it."""
    if mode.frequency < _HELD:
        return (
            f"nothing holds {mode.body}, and no sensor sees where it drifts; add a displacement sensor on it, "
            "or an element to ground that is too soft to matter, with fixed values"
        )
    return (
        f"no sensor sees the {mode.frequency:.3g} Hz mode of {mode.body}; "
        f"add a sensor on {mode.body} (or on an element attached to it)"
    )


def without_scale(file: SystemFile, loads: Collection[str]) -> frozenset[str]:
    """Those of `loads` whose mass is only seen in proportion to springs and dampers: of what they are joined to, every
    mass is a load as well, nothing is known, and no force is measured."""
    forces = any(isinstance(source, ForceInput) for source in file.inputs.values())
    if forces or any(sensor.kind == "force" for sensor in file.sensors.values()):
        return frozenset()
    group = {name: {name} for name in file.bodies}
    scaled = set(file.bodies) - set(loads)
    for element in file.elements.values():
        ends = [end for end in (element.upper, element.lower) if end in group]
        joined = set().union(*(group[end] for end in ends))
        group |= {name: joined for name in joined}
        values = (("stiffness", element.stiffness), ("damping", element.damping))
        if any(v.value > 0 and (v.fixed or quantity not in file.estimate) for quantity, v in values):
            scaled.update(ends)
    return frozenset(name for name in loads if not group[name] & scaled)


def unsupported(file: SystemFile) -> list[str]:
    """Contents of a file that identification does not support, one line each."""
    found = []
    tracks = [name for name, source in file.inputs.items() if isinstance(source, TrackInput)]
    if tracks and len(tracks) < len(file.inputs):
        other = next(name for name in file.inputs if name not in tracks)
        found.append(
            f"inputs.{other}: measured inputs beside a track are not supported; make all wheels kind track, or none"
        )
    follows = [name for name, element in file.elements.items() if element.by_load]
    if tracks and follows:
        found.append(f"elements.{follows[0]}.by_load: not supported where nothing is measured below; leave it out")
    for name in follows:
        if file.elements[name].upper not in file.bodies:
            found.append(f"elements.{name}.by_load: its upper end must be the body that is loaded")
    declared = [name for name, body in file.bodies.items() if body.load is not None]
    if not tracks and file.inputs:
        for name in sorted(without_scale(file, declared)):
            found.append(
                f"bodies.{name}.load: its mass is only seen in proportion to the springs and dampers, since no other "
                "mass, stiffness or force is known; leave load out (or add a force sensor)"
            )
    seconds = file.window / file.sample_rate
    if tracks and seconds < SHORTEST_TRACK:
        least = round(SHORTEST_TRACK * file.sample_rate)
        found.append(
            f"window: {seconds:g} s is too short to distinguish vehicle and track without measured inputs; "
            f"{least} samples at the least, a minute ({round(60 * file.sample_rate)}) is usual"
        )
    return found
