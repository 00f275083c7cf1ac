"""What the sensors of a whole system show on measured inputs: nominal structure, laws of its file, sensors' noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.laws import CLOCK_LEAD, BodyLaw, ElementLaw, SensorLaw, StructureLaw, SupportLaw
from sprung.model.laws.in_place import LawError, is_linear, put_in_place
from sprung.model.laws.placed import PlacedLaw, revalued
from sprung.model.laws.undone import undone
from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import knots
from sprung.model.simulate.nonlinear import NonlinearSimulator, Placement
from sprung.model.system import System


class SimulationError(ValueError):
    """Inputs that cannot be simulated; one line."""


@dataclass(frozen=True, slots=True)
class Ride:
    """One simulated recording."""

    sensors: FloatArray  # sensor signals, with faults and noise if requested, shape (T, S)
    states: FloatArray  # displacements, then rates, shape (T, N)
    deflection: FloatArray  # of every element, m, shape (T, E)
    rate: FloatArray  # m/s, shape (T, E)
    force: FloatArray  # of every element, N, positive in extension, its laws included, shape (T, E)


def simulate_ride(
    system: System,
    inputs: FloatArray,
    values: Mapping[str, float] | None = None,
    start: FloatArray | None = None,
    noise: np.random.Generator | None = None,
) -> Ride:
    """Simulate a system with the laws of its file.

    inputs: in the order of `system.inputs`, shape (T, I), without gaps, at `system.sample_rate`.
    values: of parameters that differ from nominal, by name (`primary_11l.stiffness`, `car.mass`), SI; those of laws
    too (`secondary_2r.coulomb_friction.force`).
    start: state at the first sample, shape (N,); at rest if left out.
    noise: where given, sensors have the noise of the system file, drawn from it.
    Errors: `SimulationError`.
    """
    inputs = _checked(system, inputs)
    system, laws, values = _with_law_values(system, values or {})
    mechanics = with_values(system, values)
    names = [channel.name for channel in system.inputs]
    driven = undone(inputs, names, laws, system.sample_rate)
    windows = np.concatenate([driven, np.zeros((len(driven), len(system.sensors)))], axis=1)[None]
    drives = knots(system, windows)[0]
    time = CLOCK_LEAD + np.arange(len(inputs)) / system.sample_rate
    _move_supports(system, laws, drives, time)
    mechanics, drives = _with_body_laws(system, mechanics, laws, drives, time)
    placements = [
        Placement(law.law, tuple(system.elements.index(name) for name in law.places), law.values)
        for law in laws
        if isinstance(law.law, ElementLaw)
    ]
    first = np.zeros(2 * mechanics.n)
    if start is not None:
        first[: system.mechanics.n], first[mechanics.n : mechanics.n + system.mechanics.n] = np.split(
            np.asarray(start, dtype=float), 2
        )
    run = NonlinearSimulator(mechanics, system.sample_rate).run(drives, placements, x0=first)
    elements = len(system.elements)  # a body's elastic mode adds elements of its own
    force = mechanics.stiffness * run.deflection + mechanics.damping * run.rate + run.force @ run.model.weights
    return Ride(
        _shown(system, laws, run.outputs, noise),
        run.states,
        run.deflection[:, :elements],
        run.rate[:, :elements],
        force[:, :elements],
    )


def _with_law_values(
    system: System, values: Mapping[str, float]
) -> tuple[System, tuple[PlacedLaw, ...], Mapping[str, float]]:
    """The system, its laws with those of the values that are theirs, and the other values."""
    try:
        laws, others = revalued(system.laws, values)
    except ValueError as error:
        raise SimulationError(str(error)) from None
    if len(others) < len(values):  # laws of the structure are put in place with their new values
        system = replace(system, whole=False)
    return system, laws, others


def with_values(system: System, values: Mapping[str, float]) -> Mechanics:
    """The mechanics with values of parameters or other element values by name.  Errors: `SimulationError`."""
    mechanics = system.mechanics
    changed = {name: getattr(mechanics, name).copy() for name in ("stiffness", "damping", "mass")}
    for name, value in values.items():
        part, _, quantity = name.rpartition(".")
        if quantity in ("stiffness", "damping") and part in system.elements:
            changed[quantity][system.elements.index(part)] = value
        elif quantity == "mass" and part in system.bodies:
            body = system.bodies.index(part)
            ratio = value / system.file.bodies[part].mass.value
            changed["mass"][mechanics.body_of_dof == body] *= ratio
        else:
            raise SimulationError(
                f"{name}: no such parameter; give ELEMENT.stiffness, ELEMENT.damping, BODY.mass or PLACE.LAW.VALUE"
            )
        if not (np.isfinite(value) and value >= 0):
            raise SimulationError(f"{name}: a value of at least 0 is needed, not {value}")
    return replace(mechanics, **changed)


def _checked(system: System, inputs: FloatArray) -> FloatArray:
    inputs = np.asarray(inputs, dtype=float)
    if inputs.ndim != 2 or inputs.shape[1] != len(system.inputs):
        raise SimulationError(f"inputs: shape (T, {len(system.inputs)}) expected, {inputs.shape} came")
    if len(inputs) < 4:
        raise SimulationError(f"inputs: at least 4 samples are needed, {len(inputs)} came")
    bad = np.flatnonzero(~np.isfinite(inputs).all(axis=0))
    if len(bad):
        raise SimulationError(f"{system.inputs[bad[0]].name}: samples are missing or not finite; every input is needed")
    return inputs


def _move_supports(system: System, laws: tuple[PlacedLaw, ...], drives: FloatArray, time: FloatArray) -> None:
    """Add movements that the measured motion of the supports does not show."""
    inputs = list(system.file.inputs)
    for placed in laws:
        if isinstance(placed.law, SupportLaw):
            moved = placed.law.movement(time, placed.values, system.sample_rate / 2)
            for place in placed.places:
                at = 2 * inputs.index(place)
                drives[:, at] += moved[0]
                drives[:, at + 1] += moved[1]


def _with_body_laws(
    system: System, mechanics: Mechanics, laws: tuple[PlacedLaw, ...], drives: FloatArray, time: FloatArray
) -> tuple[Mechanics, FloatArray]:
    for placed in laws:
        if isinstance(placed.law, StructureLaw | BodyLaw) and not (system.whole and is_linear(placed)):
            try:
                mechanics = put_in_place(system.file, mechanics, placed)
            except LawError as error:
                raise SimulationError(str(error)) from None
        if isinstance(placed.law, BodyLaw) and placed.law.load is not None:
            load = placed.law.load(time, placed.values)
            drives = np.column_stack([drives, load, np.gradient(load, 1 / system.sample_rate, edge_order=2)])
    return mechanics, drives


def _shown(
    system: System, laws: tuple[PlacedLaw, ...], truth: FloatArray, noise: np.random.Generator | None
) -> FloatArray:
    """The sensors' truth with their faults and noise."""
    shown = truth.copy()
    for placed in laws:
        if isinstance(placed.law, SensorLaw) and placed.location in system.sensors:
            column = system.sensors.index(placed.location)
            shown[:, column] = placed.law.distort(shown[:, column], placed.values, system.sample_rate)
    if noise is not None:
        shown += system.sensor_noise * noise.standard_normal(shown.shape)
    return shown
