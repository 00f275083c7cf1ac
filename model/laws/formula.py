"""A law from a formula: an element law whose force, and rate of one hidden state, are text.

Written in a system file as `formula: {formula: "a * d**3 + b * z", memory: "v - z / tau", a: 1e9, b: 2e3, tau: 0.1}`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sprung.model.laws.base import ElementLaw, ParameterSpec, Values, no_memory
from sprung.model.laws.expression import MOTION, Expression, FormulaError, parse
from sprung.model.laws.motion import Motion, Observed, SpringDamper

EFFECT = "formula"
_ANY = 1e18
_SIZES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # m, of motions; a law that is finite in the smallest only may be of that size
_PER_SECOND = 10.0  # rate over deflection of such a motion
_TIMES = (0.0, 10.0, 100.0)  # s
_MOST_FORCE = 1e15  # N; far more than anything that holds together


def formula_law(
    formula: str, memory: str, parameters: tuple[str, ...], units: dict[str, str] | None = None
) -> ElementLaw:
    """The law with this force (N) and, where `memory` is not empty, this rate of its state z (zero at first).

    Errors: `FormulaError` for text that is no formula, unknown names, and parameters that nothing uses or that have
    the name of a variable.
    """
    taken = [name for name in parameters if name in MOTION]
    if taken:
        raise FormulaError(
            f"formula {formula!r}: parameter {taken[0]!r} has the name of a variable ({', '.join(MOTION)}); "
            "choose another"
        )
    known = {*parameters, *MOTION}
    force = parse(formula, known)
    rate = parse(memory, known) if memory else None
    used = force.names | (rate.names if rate is not None else frozenset())
    if "z" in used and rate is None:
        raise FormulaError(f"formula {formula!r}: uses z; give its rate as `memory`")
    idle = [name for name in parameters if name not in used]
    if idle:
        raise FormulaError(f"formula {formula!r}: parameter {idle[0]!r} is not used")
    return ElementLaw(
        name=EFFECT,
        title="law of a formula",
        parameters=tuple(_spec(name, (units or {}).get(name, "")) for name in parameters),
        force=_evaluator(force, parameters),
        shapes=lambda seen: np.zeros((0, len(parameters))),
        absent=tuple(0.0 for _ in parameters),
        looks_like="whatever its formula says",
        confused_with=(),
        sentence=f"a force {formula}",
        strength=None,
        listed=False,
        over_time="t" in used,
        memory=int(rate is not None),
        memory_rate=no_memory if rate is None else _rate(rate, parameters),
        formula=formula,
        memory_formula=memory,
    )


def without_force(law: ElementLaw, values: Values, element: SpringDamper) -> str:
    """Where a formula says no force, in words, if there is no motion of any size in which it always does; else empty.

    A division by zero, the root of a negative number and an overflow have no force, and no window holds such a law.
    """
    found = ""
    for size in _SIZES:
        found = _undefined(law, values, element, size)
        if not found:
            return ""
    return found


def _undefined(law: ElementLaw, values: Values, element: SpringDamper, size: float) -> str:
    """The first point without a force among deflections up to `size`."""
    at = np.array([0.0, -1.0, 1.0, -0.5, 0.5])
    states = (size * at,) if law.memory else ()
    points = np.meshgrid(size * at, _PER_SECOND * size * at, np.array(_TIMES), *states, indexing="ij")
    d, v, t, *z = (point.ravel() for point in points)
    motion = Motion(d, v, t, tuple(z))
    with np.errstate(all="ignore"):
        force = np.asarray(law.force(motion, values, element), dtype=float)
        rate = np.asarray(law.memory_rate(motion, values, element), dtype=float) if law.memory else np.zeros((1, 1))
    for what, number in (("force", force), ("rate of z", rate[0])):
        bad = np.flatnonzero(~(np.abs(np.broadcast_to(number, d.shape)) < _MOST_FORCE))
        if len(bad):
            return f"no finite {what} at d = {d[bad[0]]:g} m, v = {v[bad[0]]:g} m/s"
    return ""


def _spec(name: str, unit: str) -> ParameterSpec:
    def typical(seen: Observed) -> float:
        return 1.0

    return ParameterSpec(name, unit, -_ANY, _ANY, f"{name} of the formula", typical)


def _evaluator(text: Expression, parameters: tuple[str, ...]) -> Callable[[Motion, Values, SpringDamper], Any]:
    def value(motion: Motion, p: Values, element: SpringDamper) -> Any:
        values = dict(zip(parameters, p, strict=True))
        values |= {"d": motion.deflection, "v": motion.rate, "t": motion.time}
        values |= {"k": element.stiffness, "c": element.damping}
        if len(motion.memory):
            values["z"] = motion.memory[0]
        found = text.value(values)
        if np.shape(motion.deflection) == np.shape(motion.rate) == np.shape(found):
            return found
        shape = np.broadcast_shapes(np.shape(motion.deflection), np.shape(motion.rate))
        return found + np.zeros(shape)  # a formula without motion in it still has the motion's shape

    return value


def _rate(text: Expression, parameters: tuple[str, ...]) -> Callable[[Motion, Values, SpringDamper], Any]:
    evaluate = _evaluator(text, parameters)

    def rate(motion: Motion, p: Values, element: SpringDamper) -> Any:
        return np.asarray(evaluate(motion, p, element))[None]

    return rate
