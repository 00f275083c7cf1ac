"""The equations of a system as text in C or Modelica: what FMU and Modelica exports share.

m q'' = sum of F_e h_e + forces,   F_e = -(k d + c v + laws),   d = H q + G z,   v = H q' + G z'
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sprung.model.exchange.statespace import ExchangeError
from sprung.model.laws import ElementLaw, SensorLaw
from sprung.model.laws.expression import MOTION, Expression, parse
from sprung.model.laws.in_place import is_linear
from sprung.model.laws.placed import PlacedLaw
from sprung.model.mechanics import ACCELERATION, DEFLECTION, DISPLACEMENT, FORCE, VELOCITY
from sprung.model.signals import FloatArray
from sprung.model.system import System

# words that Modelica 3.6 keeps for itself (appendix A.1), and its clock
KEYWORDS = """
algorithm and annotation block break class connect connector constant constrainedby der discrete each else elseif
elsewhen encapsulated end enumeration equation expandable extends external false final flow for function if import
impure in initial inner input loop model not operator or outer output package parameter partial protected public pure
record redeclare replaceable return stream then true type when while within time
"""


@dataclass(frozen=True, slots=True)
class EquationSite:
    """One law along one combination of elements."""

    placed: PlacedLaw
    law: ElementLaw
    weights: FloatArray  # over the elements, (E,)
    element: int  # whose k and c the law sees
    force: Expression
    memory: Expression | None


def sites(system: System) -> list[EquationSite]:
    """The laws of a whole system's elements, part by part, with formulas.  Errors: `ExchangeError` for laws that no
    formula describes, unmeasured forces and movements included."""
    found = []
    for placed in system.laws:
        law = placed.law
        if isinstance(law, SensorLaw) or is_linear(placed):
            continue  # of the measurement; part of the mechanics
        texts = () if not isinstance(law, ElementLaw) else law.parts or ((law.formula, law.memory_formula),)
        if not isinstance(law, ElementLaw) or not all(force for force, _ in texts):
            raise ExchangeError(f"{placed.location}: {law.name} has no formula and cannot be exported")
        known = {*law.names, *MOTION}
        at = [system.elements.index(name) for name in placed.places]
        for group in [at] if law.where == "pair" else [[e] for e in at]:
            weights = np.zeros(len(system.all_elements))
            weights[group[0]] = 1.0
            if len(group) == 2:
                weights[group[1]] = -1.0
            for force, rate in texts:
                memory = parse(rate, known) if rate else None
                found.append(EquationSite(placed, law, weights, group[0], parse(force, known), memory))
    return found


def linear(row: FloatArray, names: Callable[[int], str]) -> str:
    """A linear combination of a row (N,) as text: `0.5*a - b`."""
    return total(*(f"{weight!r}*{names(i)}" for i, weight in enumerate(row.tolist()) if weight != 0))


def total(*terms: str) -> str:
    """A sum as text, without terms "0.0".  Modelica admits no sign behind an operator: negative ones are subtracted."""
    return " + ".join(term for term in terms if term != "0.0").replace(" + -", " - ") or "0.0"


def output(
    system: System,
    sensor: int,
    q: Callable[[int], str],
    rate: Callable[[int], str],
    acceleration: Callable[[int], str],
    deflection: Callable[[int], str],
    force: Callable[[int], str],
) -> str:
    """What a sensor shows, in names of motions and forces."""
    m = system.mechanics
    row = {
        ACCELERATION: (m.S[sensor], acceleration),
        VELOCITY: (m.S[sensor], rate),
        DISPLACEMENT: (m.S[sensor], q),
        DEFLECTION: (m.L[sensor], deflection),
        FORCE: (m.L[sensor], force),
    }[int(m.sensor_kind[sensor])]
    return linear(*row)


def identifier(name: str) -> str:
    """A name that C and Modelica admit."""
    plain = "".join(ch if ch.isascii() and ch.isalnum() else "_" for ch in name)
    return f"{plain}_" if plain in KEYWORDS.split() else plain if not plain[:1].isdigit() else f"_{plain}"
