"""Locations of laws: elements, pairs of elements, axles."""

from __future__ import annotations

from itertools import combinations

from sprung.model.laws import ElementLaw
from sprung.model.system import System


def places(system: System, law: ElementLaw) -> list[str]:
    """Locations of an element law: elements, or pairs between the same bodies at the same x."""
    elements = system.file.elements
    if law.where == "element":
        return [name for name in elements if not law.at or name in law.at]
    pairs = level_pairs(system, list(elements))
    return [f"{a}|{b}" for a, b in pairs if elements[a].lower == elements[b].lower]


def wheelsets(system: System) -> list[str]:
    """The two supports of every axle, "left|right"."""
    elements, inputs = system.file.elements, set(system.file.inputs)
    stands_on = {name: next(iter({e.upper, e.lower} & inputs), None) for name, e in elements.items()}
    pairs = level_pairs(system, [name for name, support in stands_on.items() if support is not None])
    return [f"{stands_on[a]}|{stands_on[b]}" for a, b in pairs if stands_on[a] != stands_on[b]]


def level_pairs(system: System, names: list[str]) -> list[tuple[str, str]]:
    """Pairs of elements below the same body at the same x."""
    pairs = []
    for a, b in combinations(names, 2):
        first, second = system.file.elements[a], system.file.elements[b]
        level = first.position and second.position and first.position[0] == second.position[0]
        if level and first.upper == second.upper:
            pairs.append((a, b))
    return pairs
