"""The free variables of a fit: parameters, values of laws, initial state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.response.terms import Term
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Point:
    """Values of the free variables.

    theta: log-ratios of the system's parameters to nominal; state: of the free motion at the first sample.
    """

    theta: FloatArray  # (P,)
    terms: tuple[Term, ...]
    state: FloatArray  # (2n + b,)
    warm_start: tuple[FloatArray, ...] = ()  # laws' forces of a nearby solution, each (4N,), N


def advance(point: Point, step: FloatArray) -> Point:
    """The point after a step (P + p + states,); log-ratios move by 1 at most, laws stay within their bounds."""
    P = len(point.theta)
    theta = point.theta + np.clip(step[:P], -1.0, 1.0)
    at, terms = P, []
    for term in point.terms:
        count = len(term.parameters)
        terms.append(term.advanced(step[at : at + count]))
        at += count
    return Point(theta, tuple(terms), point.state + step[at:], point.warm_start)


def fixed(point: Point) -> np.ndarray:
    """Mask (P + p,) of theta and the terms' parameters that are held constant."""
    found = [term.fixed or (False,) * len(term.parameters) for term in point.terms]
    return np.concatenate([np.zeros(len(point.theta), dtype=bool), *(np.array(one, dtype=bool) for one in found)])


def at_active_bounds(point: Point, step: FloatArray) -> np.ndarray:
    """Mask of the entries of a step that point out of an active bound or are held, same shape as the step."""
    held = np.zeros(len(step), dtype=bool)
    at = len(point.theta)
    for term in point.terms:
        here = slice(at, at + len(term.parameters))
        held[here] = term.at_active_bounds(step[here])
        at = here.stop
    return held
