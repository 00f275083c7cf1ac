"""Forces of laws step by step in time, for trajectories on which the iteration of `forward` does not settle.

A hard stop that is hit all over a long record makes the iteration on whole trajectories diverge when it starts far
away.  Marching never does; it ends in a trajectory that the iteration then takes as its start.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.linalg import expm

from model.diagnosis.catalogue import CLOCK_LEAD, ElementLaw, Motion, SpringDamper
from model.diagnosis.catalogue.base import Values
from model.diagnosis.forward import Forward, LawForces, propagate
from model.diagnosis.plant import Plant
from model.diagnosis.spectra import OVERSAMPLING
from model.diagnosis.terms import Term
from model.signals import FloatArray
from model.simulate.etd import Site, force_steps
from model.simulate.segments import solve

_PARTS = 2 * OVERSAMPLING  # steps per sample
_ROUNDS = 4  # for the start: the periodic motion that `forward` works with begins where it ends
_SETTLED = 1e-3


def march_forces(forward: Forward, state: FloatArray) -> tuple[FloatArray, ...]:
    """Force of every law along its trajectory less its preload, one (OVERSAMPLING N,) per law, in `forward`'s order.

    state (2n + b,): the free motion at the first sample, as `forward` counts it.
    """
    loop = forward.loop(state)
    assert loop is not None
    grid, s, d0, v0 = loop.grid, loop.plant.structure, loop.d0, loop.v0
    A, rows = s.state_matrix(), s.motion_rows(loop.wide)
    step = grid.step / _PARTS
    steps = force_steps(A, s.force_columns(loop.wide), rows, step)
    fine = grid.step / OVERSAMPLING * np.arange(len(d0))
    nodes = step / 2 * np.arange(2 * _PARTS * (grid.samples - 1) + 1)
    inputs = np.hstack([CubicHermiteSpline(fine, d0, v0)(nodes), CubicSpline(fine, v0)(nodes)])
    sites = [
        Site(_preloaded(term), term.parameters, element)
        for term, element in zip(loop.terms, loop.elements, strict=True)
    ]
    first = np.zeros(s.states)
    for _ in range(_ROUNDS):
        known = inputs + propagate(A, rows, first, step / 2, len(nodes))
        solution = solve(
            steps, expm(A * grid.step), sites, known[..., None], parts=_PARTS, start=grid.start + CLOCK_LEAD
        )
        force = solution.force[:: _PARTS // OVERSAMPLING, :, 0]
        force = np.concatenate([force, np.repeat(force[-1:], len(d0) - len(force), axis=0)])
        before, first = first, _periodic_start(loop.plant, loop.answer(force))
        if np.max(np.abs(first - before)) <= _SETTLED * np.max(np.abs(solution.states)):
            break
    return tuple(force.T)


def _preloaded(term: Term) -> ElementLaw:
    """The law less the linear part that the plant carries."""
    assert isinstance(term.law, ElementLaw)
    law, (stiffness, damping) = term.law, term.preload

    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        return np.asarray(law.force(motion, p, element) - stiffness * motion.deflection - damping * motion.rate)

    return replace(law, force=force)


def _periodic_start(plant: Plant, forces: LawForces) -> FloatArray:
    """State at the first sample, (2n + b,), of the motion that periodic forces keep up."""
    grid = plant.grid
    position = grid.inverse(forces.q)[0] + forces.motion[0]
    rate = grid.inverse(1j * grid.omega[:, None] * forces.q)[0] + plant.derivative(forces.motion)[0]
    branches = grid.inverse(plant.structure.branch_forces(forces.deflections, grid.omega))[0]
    return np.concatenate([position, rate, branches])
