"""Forces of laws step by step in time, for trajectories on which the iteration of `forward` does not settle.

A hard stop that is hit all over a long record makes the iteration on whole trajectories diverge when it starts far
away.  Marching never does; it ends in a trajectory that the iteration then takes as its start.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.linalg import expm

from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.forward import Forward, propagate
from sprung.model.diagnosis.response.frf import Plant
from sprung.model.diagnosis.response.harmonic_balance import HarmonicBalance, LawForces
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import CLOCK_LEAD, ElementLaw, Motion, SpringDamper
from sprung.model.laws.base import Values
from sprung.model.signals import FloatArray
from sprung.model.simulate.etd import Site, force_steps
from sprung.model.simulate.segments import solve

_PARTS = 2 * OVERSAMPLING  # steps per sample
_HANDED = 1e-4  # change of the states that one stretch hands to the next


def march_from_rest(forward: Forward, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Forces of every law along its trajectory less its equivalent, (OVERSAMPLING N, laws), and a state, (2n + b,).

    state (2n + b,): the free motion at the first sample, beside which the laws' part begins at rest.  `forward` counts
    the free motion beside a periodic part, which moves at the first sample: what is returned is to be taken off.
    """
    loop = _loop(forward, state)
    force = _march(loop, slice(0, None), np.zeros(loop.plant.structure.states))
    return force, _state_at(loop.plant, loop.answer(force), 0)


def march_on(forward: Forward, state: FloatArray, first: int) -> FloatArray:
    """The same from sample `first` on, the forces up to there being known: those that `forward` starts from."""
    loop = _loop(forward, state)
    force = np.column_stack(forward.start_force)
    held = slice(first * OVERSAMPLING, None)
    force[held] = _march(loop, held, _state_at(loop.plant, loop.answer(force), first))
    return force


def _loop(forward: Forward, state: FloatArray) -> HarmonicBalance:
    loop = forward.loop(state)
    if loop is None:
        raise ValueError("no law of this model acts along a trajectory")
    return loop


def _march(loop: HarmonicBalance, part: slice, begin: FloatArray) -> FloatArray:
    """Forces along a part of the fine axis, (4N', laws), from the state of their motion."""
    grid, s, d0, v0 = loop.grid, loop.plant.structure, loop.d0[part], loop.v0[part]
    A, rows = s.state_matrix(), s.motion_rows(loop.wide)
    step = grid.step / _PARTS
    fine = grid.step / OVERSAMPLING * np.arange(len(d0))
    nodes = step / 2 * np.arange(2 * _PARTS * (len(d0) // OVERSAMPLING - 1) + 1)
    inputs = np.hstack([CubicHermiteSpline(fine, d0, v0)(nodes), CubicSpline(fine, v0)(nodes)])
    solution = solve(
        force_steps(A, s.force_columns(loop.wide), rows, step),
        expm(A * grid.step),
        [
            Site(_without_equivalent(term, reach), term.parameters, element)
            for term, element, reach in zip(loop.terms, loop.elements, np.transpose(loop.reach), strict=True)
        ],
        (inputs + propagate(A, rows, begin, step / 2, len(nodes)))[..., None],
        parts=_PARTS,
        start=grid.start + part.start * grid.step / OVERSAMPLING + CLOCK_LEAD,
        tolerance=_HANDED,
    )
    force = solution.force[:: _PARTS // OVERSAMPLING, :, 0]
    return np.concatenate([force, np.repeat(force[-1:], len(d0) - len(force), axis=0)])


def _without_equivalent(term: Term, reach: FloatArray) -> ElementLaw:
    """The law less the linear part that the plant carries, flat beyond its reach (deflection, rate)."""
    law, (stiffness, damping) = term.element_law, term.equivalent

    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        d, v = np.clip(motion.deflection, -reach[0], reach[0]), np.clip(motion.rate, -reach[1], reach[1])
        return np.asarray(law.force(motion._replace(deflection=d, rate=v), p, element) - stiffness * d - damping * v)

    return replace(law, force=force)


def _state_at(plant: Plant, forces: LawForces, sample: int) -> FloatArray:
    """State at a sample, (2n + b,), of the motion that periodic forces keep up."""
    grid = plant.grid
    q, bend = (grid.monomials[sample] @ p for p in (forces.motion, plant.derivative(forces.motion)))
    position = grid.inverse(forces.q)[sample] + q
    rate = grid.inverse(1j * grid.omega[:, None] * forces.q)[sample] + bend
    branches = grid.inverse(plant.structure.branch_forces(forces.deflections, grid.omega))[sample]
    return np.concatenate([position, rate, branches])
