"""Alternatives that a recording could not distinguish from the chosen model: another law in place of a finding."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.address import LawSetting, LawValue
from sprung.model.identification.nonlinear.forces import LawAlongMotion
from sprung.model.laws import ElementLaw, SpringDamper
from sprung.model.laws.motion import observe
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System


class NoRival(ValueError):
    """A law that cannot stand in another one's place; one line."""


def rival(system: System, element: str, effect: str, name: str, inputs: FloatArray) -> System:
    """The system with the law `name` in the place of `effect` at an element.

    Its values are those whose force comes nearest to the other law's along the motion that `inputs` (T, I) cause, a
    spring and a damper aside; a fit goes on from them.  Errors: `NoRival`.
    """
    law = next((one for one in system.catalogue if one.name == name), None)
    alone = element in system.elements  # neither between two, nor at a body, nor of a sensor
    if not alone or not isinstance(law, ElementLaw) or law.where != "element" or law.memory > 1:
        raise NoRival(f"{name}: cannot be put in the place of {effect} at {element}, so it is left out")
    ride, e = simulate_ride(system, inputs), system.elements.index(element)
    mechanics = system.mechanics
    own = SpringDamper(float(mechanics.stiffness[e]), float(mechanics.damping[e]))
    d, v = ride.deflection[:, e], ride.rate[:, e]
    force = ride.force[:, e] - own.stiffness * d - own.damping * v
    values = _nearest(law, d, v, force, own, system.sample_rate)
    if values is None:
        raise NoRival(f"{name}: no values of it come near {effect} at {element}, so it is left out")
    setting: LawSetting = {
        spec.name: LawValue(value=float(value), fixed=index == law.corner)
        for index, (spec, value) in enumerate(zip(law.parameters, values, strict=True))
    }
    part = system.file.elements[element]
    laws = tuple(entry if effect not in entry else {name: setting} for entry in part.laws)
    changed = part.model_copy(update={"laws": laws})
    return System(
        system.file.model_copy(update={"elements": system.file.elements | {element: changed}}), system.catalogue
    )


def _nearest(
    law: ElementLaw, d: FloatArray, v: FloatArray, force: FloatArray, own: SpringDamper, sample_rate: float
) -> Sequence[float] | None:
    along = LawAlongMotion(law, d[None], v[None], sample_rate)
    seen = observe(d, v, sample_rate, own.stiffness, own.damping)
    best, found = np.inf, None
    for trial in law.shapes(seen):
        shape = along.force([np.array([[p]]) for p in trial], own, np.zeros(1))[0]
        columns = np.stack([np.broadcast_to(shape, d.shape), d, v], axis=1)
        size = np.linalg.norm(columns, axis=0)
        if not (np.isfinite(columns).all() and size[0] > 0):
            continue
        factors = np.linalg.lstsq(columns / size, force, rcond=None)[0] / size
        left = float(np.sum((force - columns @ factors) ** 2))
        if factors[0] > 0 and left < best:
            best = left
            found = law.clip(list(law.scaled(trial, float(factors[0])) if law.strength is not None else trial))
    return None if found is None else [float(value) for value in found]
