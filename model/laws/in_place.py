"""Laws of bodies and structure applied to the mechanics, and derivatives by their values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sprung.model.laws.base import Values
from sprung.model.laws.kinds import BodyLaw, Law, StructureLaw
from sprung.model.laws.placed import PlacedLaw
from sprung.model.laws.structure import sites_of
from sprung.model.mechanics import Mechanics
from sprung.model.parameters import Parameter
from sprung.model.schema import SystemFile


@dataclass(frozen=True, slots=True)
class Follower:
    """What is multiplied by a power of one value of a law."""

    parameter: Parameter
    element: int = -1  # of the mechanics with the laws; -1: none
    stiffness: float = 0.0  # power with which that of the element grows
    damping: float = 0.0
    body: int = -1  # whose mass and inertias grow in proportion; -1: none's


class LawError(ValueError):
    """A law that cannot be put in place; one line."""


def is_linear(placed: PlacedLaw) -> bool:
    """Whether a law changes nothing but the mechanics."""
    law = placed.law
    return isinstance(law, StructureLaw) or (isinstance(law, BodyLaw) and law.load is None)


def put_in_place(file: SystemFile, mechanics: Mechanics, placed: PlacedLaw) -> Mechanics:
    """The mechanics with one law of a body or of the structure.  Errors: `LawError`."""
    law, variant = placed.law, placed.variant
    if isinstance(law, BodyLaw):
        variants = law.variants(mechanics, list(file.bodies).index(placed.location))
        variant = variant or variants[0]
        if variant not in variants:
            raise LawError(f"{placed.location}: {law.name} has no variant {variant!r}; it has {', '.join(variants)}")
    return with_law(file, mechanics, law, placed.location, placed.values, variant)


def with_law(
    file: SystemFile, mechanics: Mechanics, law: Law, location: str, values: Values, variant: str
) -> Mechanics:
    """The mechanics with a law of a body or of the structure at a location; as they are with any other law."""
    if isinstance(law, StructureLaw):
        return law.modify(mechanics, sites_of(file, location), values, variant or law.variants[0])
    if isinstance(law, BodyLaw):
        return law.modify(mechanics, list(file.bodies).index(location), values, variant)
    return mechanics


def misplaced(file: SystemFile, mechanics: Mechanics, laws: Sequence[PlacedLaw]) -> list[str]:
    """What is wrong with laws of bodies and of the structure where they are, one line each."""
    found = []
    for placed in laws:
        if isinstance(placed.law, BodyLaw | StructureLaw):
            try:
                put_in_place(file, mechanics, placed)
            except LawError as error:
                found.append(str(error))
    return found


@dataclass(frozen=True, slots=True)
class MechanicsWithLaws:
    """The mechanics with all linear laws."""

    mechanics: Mechanics
    added: tuple[str, ...] = ()  # names of the elements that they add: "car.suspended_mass"
    followers: tuple[Follower, ...] = ()  # of their values that are positive and not fixed


def all_in_place(file: SystemFile, mechanics: Mechanics, laws: Sequence[PlacedLaw]) -> MechanicsWithLaws:
    """The mechanics with all linear laws.  Errors: `LawError`."""
    found: list[Follower] = []
    added: list[str] = []
    for placed in laws:
        if is_linear(placed):
            before = len(mechanics.stiffness)
            mechanics = put_in_place(file, mechanics, placed)
            name, count = f"{placed.location}.{placed.law.name}", len(mechanics.stiffness) - before
            added += [name] if count == 1 else [f"{name}.{number}" for number in range(1, count + 1)]
            found += _followers(file, placed, len(mechanics.stiffness) - 1)
    return MechanicsWithLaws(mechanics, tuple(added), tuple(found))


def _followers(file: SystemFile, placed: PlacedLaw, added: int) -> Iterator[Follower]:
    law = placed.law
    assert isinstance(law, BodyLaw | StructureLaw)
    for i, (spec, name, value, fixed) in enumerate(
        zip(law.parameters, placed.names, placed.values, placed.fixed, strict=True)
    ):
        if fixed or value <= 0:
            continue
        parameter = Parameter(name, placed.location, f"{law.name}.{spec.name}", spec.unit, value)
        if i in law.powers:
            yield Follower(parameter, added, *law.powers[i])
        elif law.scales:
            yield Follower(parameter, body=list(file.bodies).index(placed.location))
