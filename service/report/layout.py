"""Where the parts of a system stand in a drawing: storeys by what carries what, lengths by where elements are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sprung.model.schema import ForceInput
from sprung.model.system import System

Point = tuple[float, float]

STOREY = 2.3  # drawn height between a body and what carries it
THICKNESS = 0.75  # drawn height of a body


@dataclass(frozen=True)
class Layout:
    """Where everything stands: levels count the storeys from the ground up."""

    system: System
    level: Mapping[str, int]  # of the bodies
    raised: frozenset[str]  # supports at the upper end of an element that stands on the ground or on another support
    half_length: Mapping[str, float]  # m, of each body along x
    slant: float  # sideways shift per metre of y
    rise: float

    def at(self, x: float, y: float, height: float) -> Point:
        """Projection: the left side (y > 0) lies behind, up and to the right."""
        return x + self.slant * y, height + self.rise * y

    def bottom(self, name: str) -> float:
        """Drawn height of the underside of a body, 0 for the ground and supports that are not raised."""
        return STOREY if name in self.raised else STOREY * self.level[name] if name in self.level else 0.0

    def top(self, name: str) -> float:
        return self.bottom(name) + THICKNESS if name in self.level else self.bottom(name)

    def element_position(self, element: str) -> Point:
        """(x, y) of an element; the body's own position where the file gives none."""
        item = self.system.file.elements[element]
        if item.position is not None:
            return float(item.position[0]), float(item.position[1])
        body = item.upper if item.upper in self.level else item.lower
        if body not in self.level:  # a component between an input and the ground
            return 0.0, 0.0
        position = self.system.file.bodies[body].position
        return float(position[0]), float(position[1])

    @property
    def railway(self) -> bool:
        """Whether what stands on moving supports has a left and a right side, as a vehicle on rails; else a rig."""
        supports = {name for name, source in self.system.file.inputs.items() if not isinstance(source, ForceInput)}
        sides = {
            self.element_position(name)[1]
            for name, item in self.system.file.elements.items()
            if item.lower in supports or item.upper in supports
        }
        return min(sides, default=0.0) < 0.0 < max(sides, default=0.0)


def lay_out(system: System) -> Layout:
    """Levels by what carries what; lengths by where elements are attached."""
    file = system.file
    level = dict.fromkeys(file.bodies, 1)
    for _ in file.bodies:
        for element in file.elements.values():
            if element.upper in level and element.lower in level and element.upper != element.lower:
                level[element.upper] = min(max(level[element.upper], level[element.lower] + 1), len(level))
    reach: dict[str, float] = {}
    for name, body in file.bodies.items():
        away = [
            abs(item.position[0] - body.position[0])
            for item in file.elements.values()
            if item.position is not None and name in (item.upper, item.lower)
        ]
        reach[name] = 1.25 * max(away, default=0.0) + 0.35
    single = all(item.position is None for item in file.elements.values())
    carried = [(item.upper, item.lower) for item in file.elements.values() if not {item.upper, item.lower} & set(level)]
    raised = frozenset(upper if upper in file.inputs else lower for upper, lower in carried)
    return Layout(system, level, raised, reach, 0.0 if single else 0.62, 0.0 if single else 0.34)
