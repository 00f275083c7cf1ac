"""A formula that a diagnosis found as a law of one's own: it has a name then, and is sought like any other.

`sprung diagnose --write-laws FILE` writes a Python file of calls of `saved_law`, `--laws FILE` reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from sprung.model.laws.base import ElementLaw, ParameterSpec
from sprung.model.laws.formula import formula_law
from sprung.model.laws.grammar import DECAYS, filtered
from sprung.model.laws.motion import UNIT_ELEMENT, Motion, Observed
from sprung.model.signals import FloatArray

_TRIED = (0.5, 1.0, 2.0)  # factors on saved values of nonlinear parameters
_FACTOR = 100.0  # either way, that such a value may be otherwise


def saved_law(
    name: str, formula: str, values: Mapping[str, tuple[float, str]], memory: str = "", title: str = ""
) -> ElementLaw:
    """A law with a name from a formula in d, v and z; values: number and unit of every parameter as they were found.

    Errors: `FormulaError` for text that is no formula.
    """
    names = tuple(values)
    law = formula_law(formula, memory, names, {key: unit for key, (_, unit) in values.items()})
    found = np.array([value for value, _ in values.values()], dtype=float)
    linear = [_linear(law, found, i) for i in range(len(names))]
    sought = [np.array([1.0]) if straight else np.array(_TRIED) for straight in linear]
    trials = found * np.array(list(product(*sought)), dtype=float)
    words = ", ".join(f"{key} {{{key}}}" for key in names)
    return replace(
        law,
        name=name,
        title=title or name.replace("_", " "),
        parameters=tuple(map(_spec, law.parameters, found, linear)),
        shapes=lambda seen: trials,
        absent=tuple(0.0 if straight else float(v) for v, straight in zip(found, linear, strict=True)),
        strength=linear.index(True) if linear.count(True) == 1 else None,
        sentence=f"{title or name.replace('_', ' ')}, {words}",
        listed=True,
        path=filtered(law, names.index("tau")) if memory == DECAYS and "tau" in names else None,
    )


def _linear(law: ElementLaw, values: FloatArray, at: int) -> bool:
    """Whether the force is proportional to one parameter, together with all that it is linear in."""
    d, v = np.linspace(-1.1e-2, 1e-2, 9), np.linspace(0.11, -0.1, 9)
    motion = Motion(d, v, 0.0, (0.7 * d,) if law.memory else ())

    def force(factor: float) -> FloatArray:
        changed = values.copy()
        changed[at] *= factor
        return np.asarray(law.force(motion, tuple(changed.tolist()), UNIT_ELEMENT), dtype=float)

    low, middle, high = force(1.0), force(2.0), force(3.0)
    near = 1e-9 * float(np.abs(low).max())
    straight = np.allclose(high - middle, middle - low, rtol=1e-9, atol=near)
    return bool(np.any(middle != low) and straight)


def _spec(spec: ParameterSpec, value: float, linear: bool) -> ParameterSpec:
    def typical(seen: Observed) -> float:
        return abs(float(value)) or 1.0

    if linear or value <= 0:
        return replace(spec, typical=typical)
    return replace(spec, low=value / _FACTOR, high=value * _FACTOR, log=True, typical=typical)
