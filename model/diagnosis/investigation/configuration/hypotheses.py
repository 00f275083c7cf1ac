"""What may be wrong between a rig and its channels: signs, exchanges, delays, scales, positions of sensors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np

from sprung.model.diagnosis.investigation.configuration import changes
from sprung.model.diagnosis.investigation.configuration.effects import (
    CHANNELS_SWAPPED,
    NODE_DELAY,
    ONE_GAIN,
    ONE_LAG,
    SENSOR_POSITION,
    SIGN_REVERSED,
    WRONG_SCALE,
    Hypothesis,
    SetupPlace,
)
from sprung.model.diagnosis.investigation.configuration.response import Group, ModelResponse
from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.schema import MotionSensor, Sensor, SupportInput
from sprung.model.sensor_kinds import KINDS
from sprung.model.system import System

_ORDERS = {"acceleration": 2, "velocity": 1, "displacement": 0}  # derivatives that a sensor of a point shows
_STANDARD_GRAVITY = 9.80665  # m/s^2
_ALIKE = 1e-6  # m, of positions that mirror each other


def hypotheses(one: ModelResponse, system: System, signals: Signals, rules: SetupRules) -> Iterator[Hypothesis]:
    """All of them with the misfit that they leave by spectra."""
    wired = Wiring(system, signals)
    yield from _signs(one, signals, wired)
    yield from _exchanges(one, system, signals, wired)
    yield from _delays(one, wired, rules)
    yield from _scales(one, wired, rules)
    if signals.force_names and not signals.support_names:
        yield from _against_forces(one, wired, rules)
    yield from _positions(one, system, signals, rules)
    yield from _ordinary(one, signals, rules)


class Wiring:
    """Which channels belong together: those of one body, of one kind, of one place."""

    def __init__(self, system: System, signals: Signals) -> None:
        self.system, self.signals = system, signals
        listed = list(system.file.sensors.values())
        self.sensors = [listed[int(i)] for i in signals.sensor_index]
        self.body = [sensor.body if isinstance(sensor, MotionSensor) else None for sensor in self.sensors]
        self.kind = [sensor.kind for sensor in self.sensors]
        self.carries: dict[str, list[int]] = {body: [] for body in system.bodies}  # supports right below a body
        self.place: dict[int, tuple[float, float]] = {}
        for element in system.file.elements.values():
            for body, support in ((element.upper, element.lower), (element.lower, element.upper)):
                if body in self.carries and support in signals.support_names:
                    at = signals.support_names.index(support)
                    self.carries[body].append(at)
                    self.place[at] = element.position or (0.0, 0.0)

    def name(self, group: Group) -> str:
        """Channels of a group joined by "|"."""
        names = [self.signals.sensor_names[i] for i in group.sensors]
        for support in (self.signals.support_names[j] for j in group.supports):
            names += [f"{support}.{quantity}" for quantity in self._measured(support)]
        return "|".join([*names, *(self.signals.force_names[k] for k in group.forces)])

    def site(self, group: Group, location: str = "") -> SetupPlace:
        """A group of channels as the place of a fault of theirs; location: its name, by default that of its channels.

        A linear system answers all inputs times a factor with all sensors times this factor.
        """
        sensors, supports, forces = (tuple(range(n)) for n in self._counts)
        every, inputs = Group(sensors), Group((), supports, forces)
        inverse = {every: inputs, inputs: every}.get(group, Group())
        return SetupPlace(location or self.name(group), group, inverse_at=self.name(inverse))

    @property
    def _counts(self) -> tuple[int, int, int]:
        """Numbers of sensors, supports and measured forces."""
        return len(self.sensors), len(self.signals.support_names), len(self.signals.force_names)

    def _measured(self, support: str) -> tuple[str, ...]:
        source = self.system.file.inputs[support]
        return tuple(source.measured) if isinstance(source, SupportInput) else ()

    @property
    def all_accelerations(self) -> bool:
        """Whether sensors and supports are measured by nothing but accelerations."""
        supports = [self._measured(support) for support in self.signals.support_names]
        return all(kind == "acceleration" for kind in (*self.kind, *(q for measured in supports for q in measured)))

    def groups(self) -> list[Group]:
        """Single channels, and what may share a node, a kind or a scale."""
        everything = range(len(self.sensors))
        found = [Group((i,)) for i in everything]
        found += [Group((), (j,)) for j in range(len(self.signals.support_names))]
        for body in self.system.bodies:
            own = tuple(i for i in everything if self.body[i] == body)
            below = tuple(dict.fromkeys(self.carries[body]))
            found += [Group(own), Group((), below), Group(own, below) if own and below else Group()]
        found += [Group(tuple(i for i in everything if self.kind[i] == kind)) for kind in dict.fromkeys(self.kind)]
        found += [Group(tuple(everything)), Group((), tuple(range(len(self.signals.support_names))))]
        found += [Group((), axle) for axle in self.axles()]
        return [group for group in dict.fromkeys(found) if group.sensors or group.supports]

    def axles(self) -> list[tuple[int, ...]]:
        """Supports at the same x."""
        at = sorted({round(x, 6) for x, _ in self.place.values()})
        axles = [tuple(sorted(j for j, (x, _) in self.place.items() if abs(x - here) < _ALIKE)) for here in at]
        return [axle for axle in axles if len(axle) > 1]

    def mirrored(self, axis: int) -> Iterator[tuple[list[tuple[int, int]], list[tuple[int, int]]]]:
        """Pairs of sensors and of supports in mirrored places: of each body, of all sensors, of all supports."""
        every = list(range(len(self.sensors)))
        for chosen in [[i for i in every if self.body[i] == body] for body in self.system.bodies] + [every]:
            pairs = self._pairs({i: self._position(i) for i in chosen if self._turns(i)}, axis)
            if len(pairs) > 1:
                yield pairs, []
        supports = self._pairs(self.place, axis)
        if len(supports) > 1:
            yield [], supports

    def between_bodies(self) -> Iterator[list[tuple[int, int]]]:
        """Pairs of all sensors of two bodies that carry the same kinds of them: their nodes or plugs exchanged."""
        for first, second in combinations(self.system.bodies, 2):
            here, there = ([i for i, body in enumerate(self.body) if body == name] for name in (first, second))
            if len(here) > 1 and [self.kind[i] for i in here] == [self.kind[i] for i in there]:
                yield list(zip(here, there, strict=True))

    def _turns(self, i: int) -> bool:
        return _is_of_a_point(self.sensors[i])

    def _position(self, i: int) -> tuple[float, float]:
        sensor = self.sensors[i]
        assert isinstance(sensor, MotionSensor)
        return sensor.position or self.system.file.bodies[sensor.body].position

    def _pairs(self, places: dict[int, tuple[float, float]], axis: int) -> list[tuple[int, int]]:
        found = []
        for i, j in combinations(places, 2):
            centre = 0.0 if axis == 1 else float(np.mean([place[0] for place in places.values()]))
            mirror = list(places[i])
            mirror[axis] = 2 * centre - mirror[axis]
            if np.abs(np.subtract(mirror, places[j])).max() < _ALIKE and places[i] != places[j]:
                found.append((i, j))
        return found


def _signs(one: ModelResponse, signals: Signals, wired: Wiring) -> Iterator[Hypothesis]:
    for group in wired.groups():
        name = signals.support_names[group.supports[0]] if len(group.supports) == 1 and not group.sensors else ""
        misfit = one.misfit(one.turned(group))
        undo, alone = changes.turn(group.sensors, group.supports), len(group.sensors) + len(group.supports) == 1
        yield Hypothesis(SIGN_REVERSED, wired.site(group, name), None, misfit, undo, unranked=alone)
    for j in range(len(signals.force_names)):
        misfit = one.misfit(one.predicted - 2 * one.of_force[:, :, j])
        site = wired.site(Group(forces=(j,)))
        yield Hypothesis(SIGN_REVERSED, site, None, misfit, changes.turn(forces=[j]), unranked=True)


def _exchanges(one: ModelResponse, system: System, signals: Signals, wired: Wiring) -> Iterator[Hypothesis]:
    def hypothesis(sensors: Sequence[tuple[int, int]], supports: Sequence[tuple[int, int]]) -> Hypothesis:
        names = [signals.sensor_names[i] for pair in sensors for i in pair]
        names += [signals.support_names[j] for pair in supports for j in pair]
        misfit = one.misfit(_exchanged(one, sensors, supports))
        undo = changes.exchange(list(sensors), list(supports))
        return Hypothesis(CHANNELS_SWAPPED, SetupPlace("|".join(names)), None, misfit, undo, unranked=len(names) == 2)

    for i, j in combinations(range(len(wired.sensors)), 2):
        if wired.kind[i] == wired.kind[j]:
            yield hypothesis([(i, j)], [])
    for i, j in combinations(range(len(signals.support_names)), 2):
        yield hypothesis([], [(i, j)])
    for axis in (1, 0):
        for sensors, supports in wired.mirrored(axis):
            yield hypothesis(sensors, supports)
    for pairs in wired.between_bodies():
        yield hypothesis(pairs, [])


def _exchanged(
    one: ModelResponse, sensors: Iterable[tuple[int, int]], supports: Iterable[tuple[int, int]]
) -> ComplexArray:
    plant, part = one.forward.plant, one.forward.part
    band = slice(1, part.grid.band.stop)
    predicted = one.predicted.copy()
    for i, j in supports:
        G, u = plant.sensor_of_support[band], part.support[band]
        predicted = predicted + (G[:, :, i] - G[:, :, j]) * (u[:, j] - u[:, i])[:, None]
    for i, j in sensors:
        predicted[:, [i, j]] = predicted[:, [j, i]]
    return predicted


def _delays(one: ModelResponse, wired: Wiring, rules: SetupRules) -> Iterator[Hypothesis]:
    """Nodes are late, not early: where a group seems early, the others are late.

    A sensor that is late alone is a fault of that sensor; what is measured of a support is late together.
    """
    for group in wired.groups():
        if len(group.sensors) == 1 and not group.supports:
            continue
        late = one.delay(group, rules)
        if late > 0:
            yield Hypothesis.of(
                NODE_DELAY, SetupPlace(wired.name(group), group), late, one.misfit(one.late(group, late))
            )


def _scales(one: ModelResponse, wired: Wiring, rules: SetupRules) -> Iterator[Hypothesis]:
    for group in wired.groups():
        if group.sensors and group.supports:
            continue
        if len(group.supports) == len(wired.signals.support_names) > 1:
            continue  # the same as all sensors the other way
        ratio = one.ratio(group)
        if wired.all_accelerations and rules.gravity_least < ratio < rules.gravity_most:
            continue  # the others are in g: they show less by as much
        if np.isfinite(ratio) and (ratio > rules.scale or 0 < ratio < 1 / rules.scale):
            misfit = one.misfit(one.scaled(group, ratio))
            yield Hypothesis.of(WRONG_SCALE, wired.site(group), ratio, misfit)


def _is_gravity(ratio: float, rules: SetupRules) -> bool:
    return bool(ratio > 0 and abs(np.log(ratio / _STANDARD_GRAVITY)) < rules.gravity)


def _against_forces(one: ModelResponse, wired: Wiring, rules: SetupRules) -> Iterator[Hypothesis]:
    """All sensors late, or in another unit, against the measured forces, or these against them.

    With resonances a tenth off, spectra are not comparable; above all modes the response to forces depends on the
    masses only.  A ratio of standard gravity is attributed to the sensors, any other to the forces, which are fewer.
    """
    if len(wired.sensors) < 2:
        return
    inert = one.above(rules.above * one.highest_mode)
    before = inert.misfit(inert.predicted)
    sensors, forces = (
        Group(tuple(range(len(wired.sensors)))),
        Group((), (), tuple(range(len(wired.signals.force_names)))),
    )
    late = inert.delay(sensors, rules)
    group = sensors if late > 0 else forces
    late = late if late > 0 else inert.delay(forces, rules)
    if late > rules.soonest * one.step and inert.misfit(inert.late(group, late)) < rules.by_mass * before:
        misfit = one.misfit(one.late(group, late))
        yield Hypothesis.of(NODE_DELAY, SetupPlace(wired.name(group), group), late, misfit, by_mass=True)
    ratio = inert.ratio(sensors)
    if not (np.isfinite(ratio) and (ratio > rules.scale or 0 < ratio < 1 / rules.scale)):
        return
    group = sensors if _is_gravity(max(ratio, 1 / ratio), rules) else forces
    ratio = ratio if group is sensors else 1 / ratio
    if inert.misfit(inert.scaled(group, ratio)) < rules.by_mass * before:
        misfit = one.misfit(one.scaled(group, ratio))
        yield Hypothesis.of(WRONG_SCALE, wired.site(group), ratio, misfit, by_mass=True)


def _positions(one: ModelResponse, system: System, signals: Signals, rules: SetupRules) -> Iterator[Hypothesis]:
    """Sensors on bodies that turn, elsewhere than the file says: along x or y."""
    dofs = list(system.mechanics.dofs)
    for i, name in enumerate(map(str, signals.sensor_names)):
        sensor = system.file.sensors[name]
        if not (isinstance(sensor, MotionSensor) and _is_of_a_point(sensor)):
            continue
        for axis, turn in ((0, "pitch"), (1, "roll")):
            if f"{sensor.body}.{turn}" not in dofs:
                continue
            offset, change = sensor_offset(one, system, i, name, axis)
            if abs(offset) >= rules.offset:
                predicted = one.predicted.copy()
                predicted[:, i] += offset * change
                yield Hypothesis.of(SENSOR_POSITION, SetupPlace(name, Group((i,)), axis), offset, one.misfit(predicted))


def sensor_offset(one: ModelResponse, system: System, i: int, name: str, axis: int) -> tuple[float, ComplexArray]:
    """By how much a sensor sits elsewhere along an axis, m, and what one metre would change, (F,)."""
    sensor = system.file.sensors[name]
    assert isinstance(sensor, MotionSensor)
    dof = system.mechanics.dofs.index(f"{sensor.body}.{('pitch', 'roll')[axis]}")
    change = (1j * one.omega) ** _ORDERS[KINDS[sensor.kind].shows] * one.motion[:, dof]
    error = one.measured[:, i] - one.predicted[:, i]
    size = max(float(np.sum(np.abs(change) ** 2)), 1e-300)
    return float(np.sum(np.real(change.conj() * error)) / size), change


def _is_of_a_point(sensor: Sensor) -> bool:
    return isinstance(sensor, MotionSensor) and not KINDS[sensor.kind].axis


def _ordinary(one: ModelResponse, signals: Signals, rules: SetupRules) -> Iterator[Hypothesis]:
    """Gain and lag of single sensors: no faults of a set-up, but what a position may be mistaken for."""
    for i, name in enumerate(map(str, signals.sensor_names)):
        site = SetupPlace(name, group := Group((i,)))
        ratio, late = one.ratio(group), one.delay(group, rules)
        if ratio > 0:
            yield Hypothesis.of(ONE_GAIN, site, ratio, one.misfit(one.scaled(group, ratio)))
        yield Hypothesis.of(ONE_LAG, site, late, one.misfit(one.late(group, late)))
