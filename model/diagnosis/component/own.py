"""Pieces for laws that have none in `pieces`, such as user-defined ones, derived from the law's declaration.

If the force is linear in one parameter, that is its strength, and the others are shapes.  Otherwise a strength is added
that must result as 1.  The force may be proportional to the element's spring or damper, which are estimated beside it;
laws that depend on both otherwise cannot be expressed as a sum of columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import HYSTERESIS, STATIC, FittedPiece, Piece, Shape
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.laws import UNIT_ELEMENT, ElementLaw, Law, Observed, SpringDamper, observe
from sprung.model.laws.along import force_along
from sprung.model.signals import FloatArray

_TINY = 1e-300

Scale = Callable[[SpringDamper], float]  # N per strength, factor of a proportional force


def observed(motion: ElementMotion, element: SpringDamper) -> Observed:
    """Sizes of a component's motion, in the form that laws expect."""
    d = motion.deflection - motion.middle
    return observe(d, motion.rate, 1 / motion.step, element.stiffness, element.damping)


def own_pieces(laws: Sequence[Law], element: str, seen: Observed, notes: list[str]) -> tuple[Piece, ...]:
    """Pieces of the laws that can be searched at an element; notes: a line that names the others is appended."""
    pieces, others = [], []
    for law in laws:
        if isinstance(law, ElementLaw) and law.at and element not in law.at:
            continue
        piece = own_piece(law, seen) if isinstance(law, ElementLaw) and law.where == "element" else None
        others += [law.name] if piece is None else []
        pieces += [] if piece is None else [piece]
    if others:
        notes.append(
            f"{element}: not searched here: {', '.join(others)}: a component test tries laws of an element whose force "
            "is linear in `strength`, and follows from the motion alone or with the element's stiffness or damping as "
            "a factor"
        )
    return tuple(pieces)


def own_piece(law: ElementLaw, seen: Observed) -> Piece | None:
    """A law as a piece of a component's force; None if its force is not a sum of columns."""
    trials = np.atleast_2d(np.asarray(law.shapes(seen), dtype=float))
    scale = None if trials.shape[1:] != (len(law.parameters),) or not len(trials) else _scale(law, trials[0], seen)
    if scale is None:
        return None
    strong, of_element = law.strength, scale
    zero = 0.0 if strong is None else law.absent[strong]
    others = [i for i in range(len(law.parameters)) if i != strong]

    def parameters(strengths: FloatArray, shape: Shape, element: SpringDamper) -> tuple[float, ...]:
        values = dict(zip(others, map(float, shape), strict=True))
        if strong is not None:
            values[strong] = zero + float(strengths[0]) / of_element(element)
        return tuple(values[i] for i in range(len(law.parameters)))

    def plausible(fitted: FittedPiece) -> bool:
        if not law.admits(tuple(fitted.values.values())):
            return False
        whole = float(fitted.strengths[0]) / of_element(fitted.element)
        return strong is not None or abs(whole - 1) < fitted.rules.lost

    def limits(sizes: MotionSizes) -> list[tuple[float, float]]:
        return [_limits(law, i, seen, sizes.reach) for i in others]

    return Piece(
        law=law,
        shapes=tuple(law.parameters[i].name for i in others),
        grid=lambda sizes: np.unique(trials[:, others], axis=0),
        limits=limits,
        signs=(1 if strong is None else _sign(law, strong),),
        parameters=parameters,
        shape_of=lambda values: tuple(float(values[i]) for i in others),
        kind=HYSTERESIS if law.memory else STATIC,
        plausible=plausible,
    )


def _limits(law: ElementLaw, index: int, seen: Observed, reach: float) -> tuple[float, float]:
    """Search range of a shape: admissible, and within a factor `reach` of the typical size."""
    spec = law.parameters[index]
    size = abs(float(spec.typical(seen)))
    if not np.isfinite(size) or size == 0.0:
        size = 1.0
    low = max(spec.low, size / reach if spec.low >= 0 else -size * reach)
    high = min(spec.high, size * reach)
    return (low, high) if low < high else (spec.low, spec.high)


def _sign(law: ElementLaw, index: int) -> int:
    """Admissible sign of the strength: 1, -1, or 0 for either."""
    spec, zero = law.parameters[index], law.absent[index]
    return int(spec.low >= zero) - int(spec.high <= zero)


def _scale(law: ElementLaw, values: FloatArray, seen: Observed) -> Scale | None:
    """Factor of the force beside its strength; None if not linear in it, or dependent on both values of the element.

    Tested along two oscillations of the observed size.
    """
    swing = np.linspace(0.0, 4 * np.pi, 81)
    d, v = seen.deflection_rms * np.sqrt(2) * np.sin(swing), seen.rate_rms * np.sqrt(2) * np.cos(swing)
    time = swing * seen.deflection_rms / max(seen.rate_rms, _TINY)

    def force(element: SpringDamper, factor: float = 1.0) -> FloatArray:
        with np.errstate(all="ignore"):
            found = force_along(law, tuple(law.scaled(values.tolist(), factor)), d, v, time, element)
        return np.broadcast_to(np.asarray(found, dtype=float), d.shape)

    def same(one: FloatArray, other: FloatArray) -> bool:
        return bool(np.allclose(one, other, rtol=1e-6, atol=1e-9 * float(np.max(np.abs(other), initial=0.0))))

    whole = force(UNIT_ELEMENT)
    if not np.all(np.isfinite(whole)) or (law.strength is not None and not same(force(UNIT_ELEMENT, 2.0), 2.0 * whole)):
        return None
    stiffer, damped = force(SpringDamper(2.0, 1.0)), force(SpringDamper(1.0, 2.0))
    if same(stiffer, whole) and same(damped, whole):
        return lambda element: 1.0
    if same(stiffer, 2.0 * whole) and same(damped, whole):
        return lambda element: max(float(element.stiffness), _TINY)
    if same(damped, 2.0 * whole) and same(stiffer, whole):
        return lambda element: max(float(element.damping), _TINY)
    return None
