"""Values of everything that a fit leaves free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.response.terms import Term
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Point:
    """Values of everything that is free."""

    theta: FloatArray  # (P,)
    terms: tuple[Term, ...]
    state: FloatArray  # (2n + b,)
    warm_start: tuple[FloatArray, ...] = ()  # the laws' forces on a trajectory nearby, each (4N,), to start from


def advance(point: Point, step: FloatArray) -> Point:
    P = len(point.theta)
    theta = point.theta + np.clip(step[:P], -1.0, 1.0)
    at, terms = P, []
    for term in point.terms:
        count = len(term.parameters)
        terms.append(term.advanced(step[at : at + count]))
        at += count
    return Point(theta, tuple(terms), point.state + step[at:], point.warm_start)


def fixed(point: Point) -> np.ndarray:
    """Which of theta and the terms' parameters no step may move, (P + p,)."""
    found = [term.fixed or (False,) * len(term.parameters) for term in point.terms]
    return np.concatenate([np.zeros(len(point.theta), dtype=bool), *(np.array(one, dtype=bool) for one in found)])


def held_back(point: Point, step: FloatArray) -> np.ndarray:
    """Which entries of a step would take a law's parameter over a bound that it stands at, as the step."""
    held = np.zeros(len(step), dtype=bool)
    at = len(point.theta)
    for term in point.terms:
        here = slice(at, at + len(term.parameters))
        held[here] = term.held_back(step[here])
        at = here.stop
    return held
