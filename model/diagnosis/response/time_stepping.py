"""Time stepping of laws' forces, for trajectories on which the harmonic balance does not converge.

With a hard stop that is hit throughout a long record, the iteration over whole trajectories diverges from a remote
start.  Time stepping does not, and its result is the initial guess of that iteration.
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
_HANDED = 1e-4  # change of the states passed from one segment to the next


def march_from_rest(forward: Forward, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Forces of the laws along their trajectory less their equivalents, (OVERSAMPLING N, m), and a state, (2n + b,).

    state: of the free motion at the first sample, (2n + b,); the response to the laws begins at rest.  `forward` adds
    the free motion to a periodic response, which is in motion at the first sample: subtract the returned state.
    """
    balance = _balance_of(forward, state)
    force = _march(balance, slice(0, None), np.zeros(balance.plant.structure.states))
    return force, _state_at(balance.plant, balance.solution(force), 0)


def march_from(forward: Forward, state: FloatArray, first: int) -> FloatArray:
    """Forces (OVERSAMPLING N, m), integrated from sample `first` on; earlier ones are those of the warm start."""
    balance = _balance_of(forward, state)
    force = np.column_stack(forward.warm_start)
    held = slice(first * OVERSAMPLING, None)
    force[held] = _march(balance, held, _state_at(balance.plant, balance.solution(force), first))
    return force


def _balance_of(forward: Forward, state: FloatArray) -> HarmonicBalance:
    balance = forward.harmonic_balance(state)
    if balance is None:
        raise ValueError("no law of this model is evaluated in time")
    return balance


def _march(balance: HarmonicBalance, part: slice, begin: FloatArray) -> FloatArray:
    """Forces along a part of the oversampled axis, (4N', m), from an initial state (2n + b,)."""
    grid, s, d0, v0 = balance.grid, balance.plant.structure, balance.d0[part], balance.v0[part]
    if not (np.isfinite(d0).all() and np.isfinite(v0).all()):
        raise FloatingPointError("the motion without the laws' forces leaves the range of numbers")
    A, rows = s.state_matrix(), s.motion_rows(balance.wide)
    step = grid.step / _PARTS
    fine = grid.step / OVERSAMPLING * np.arange(len(d0))
    nodes = step / 2 * np.arange(2 * _PARTS * (len(d0) // OVERSAMPLING - 1) + 1)
    inputs = np.hstack([CubicHermiteSpline(fine, d0, v0)(nodes), CubicSpline(fine, v0)(nodes)])
    solution = solve(
        force_steps(A, s.force_columns(balance.wide), rows, step),
        expm(A * grid.step),
        [
            Site(_without_equivalent(term, reach), term.parameters, element)
            for term, element, reach in zip(balance.terms, balance.elements, np.transpose(balance.reach), strict=True)
        ],
        (inputs + propagate(A, rows, begin, step / 2, len(nodes)))[..., None],
        parts=_PARTS,
        start=grid.start + part.start * grid.step / OVERSAMPLING + CLOCK_LEAD,
        tolerance=_HANDED,
    )
    force = solution.force[:: _PARTS // OVERSAMPLING, :, 0]
    return np.concatenate([force, np.repeat(force[-1:], len(d0) - len(force), axis=0)])


def _without_equivalent(term: Term, reach: FloatArray) -> ElementLaw:
    """The law less its equivalent, constant beyond its reach (deflection m, rate m/s)."""
    law, (stiffness, damping) = term.element_law, term.equivalent

    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        d, v = np.clip(motion.deflection, -reach[0], reach[0]), np.clip(motion.rate, -reach[1], reach[1])
        return np.asarray(law.force(motion._replace(deflection=d, rate=v), p, element) - stiffness * d - damping * v)

    return replace(law, force=force)


def _state_at(plant: Plant, forces: LawForces, sample: int) -> FloatArray:
    """State (2n + b + f,) at a sample of the periodic response to forces."""
    grid = plant.grid
    q, bend = (grid.monomials[sample] @ p for p in (forces.motion, plant.derivative(forces.motion)))
    position = grid.inverse(forces.q)[sample] + q
    rate = grid.inverse(1j * grid.omega[:, None] * forces.q)[sample] + bend
    branches = grid.inverse(plant.structure.branch_forces(forces.deflections, grid.omega))[sample]
    return plant.structure.state(position, rate, branches)
