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
from model.diagnosis.forward import Forward, propagate
from model.diagnosis.spectra import DEGREE, OVERSAMPLING
from model.diagnosis.terms import Term, is_waveform
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
    terms = [term for term in forward.terms if is_waveform(term)]
    plant, grid = forward.plant, forward.part.grid
    s = plant.structure
    ports = np.array([term.port(forward.system) for term in terms])
    d0, v0 = forward.fine_motion(ports, state)
    wide = np.pad(ports, ((0, 0), (0, len(s.H) - ports.shape[1])))
    A, rows = s.state_matrix(), s.motion_rows(wide)
    step = grid.step / _PARTS
    steps = force_steps(A, s.force_columns(wide), rows, step)
    fine = grid.step / OVERSAMPLING * np.arange(len(d0))
    nodes = step / 2 * np.arange(2 * _PARTS * (grid.samples - 1) + 1)
    inputs = np.hstack([CubicHermiteSpline(fine, d0, v0)(nodes), CubicSpline(fine, v0)(nodes)])
    sites = [Site(_preloaded(term), term.parameters, forward.element_of(term)) for term in terms]
    first = np.zeros(s.states)
    for _ in range(_ROUNDS):
        known = inputs + propagate(A, rows, first, step / 2, len(nodes))
        solution = solve(
            steps, expm(A * grid.step), sites, known[..., None], parts=_PARTS, start=grid.start + CLOCK_LEAD
        )
        force = solution.force[:: _PARTS // OVERSAMPLING, :, 0]
        force = np.concatenate([force, np.repeat(force[-1:], len(d0) - len(force), axis=0)])
        before, first = first, _periodic_start(forward, wide @ s.H, force)
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


def _periodic_start(forward: Forward, along: FloatArray, force: FloatArray) -> FloatArray:
    """State at the first sample, (2n + b,), of the motion that a periodic force (OVERSAMPLING N, m) keeps up."""
    plant, grid = forward.plant, forward.part.grid
    line = np.zeros((DEGREE + 1, force.shape[1]))
    line[1] = force[-1] - force[0]
    swinging = force - (grid.fine_time / grid.length)[:, None] * line[1]
    line[0] = swinging.mean(axis=0)
    spectrum = grid.coarse_spectrum(swinging - line[0])
    q = -np.einsum("fnm,fm->fn", plant.receptance, spectrum @ along)
    steady = plant.polynomial_response(-line @ along)
    position = grid.inverse(q)[0] + steady[0]
    rate = grid.inverse(1j * grid.omega[:, None] * q)[0] + plant.derivative(steady)[0]
    branches = grid.inverse(plant.structure.branch_forces(q @ plant.structure.H.T, grid.omega))[0]
    return np.concatenate([position, rate, branches])
