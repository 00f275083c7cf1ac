"""The total motion of a solution: periodic, polynomial and free part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward, propagate
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Motions:
    """Total motion of a part as spectra; rates are transformed separately, since records are not periodic."""

    deflection: ComplexArray  # (F, elements)
    rate: ComplexArray  # (F, elements)
    position: ComplexArray  # of the degrees of freedom, (F, n)
    velocity: ComplexArray  # of the degrees of freedom, (F, n)
    acceleration: ComplexArray  # of the degrees of freedom, (F, n)


def motions_of(forward: Forward, forces: LawForces | None, state: FloatArray) -> Motions:
    """Motion with laws' forces and free motion from a state (N,); forces None: that of the linear part alone."""
    plant, grid = forward.plant, forward.part.grid
    s = plant.structure
    n = len(s.mass)
    jw = 1j * grid.omega[:, None]
    q_poly, d_poly = forward.polynomial
    periodic = forward.linear_deflection
    if forces is not None:
        periodic = periodic + forces.deflections
        q_poly, d_poly = q_poly + forces.motion, d_poly + forces.motion @ s.H.T
    A = s.state_matrix()
    free = propagate(A, np.eye(len(A)), state, grid.step, grid.samples)
    swinging = grid.forward(free)
    d = periodic + grid.monomial_spectra @ d_poly + swinging[:, :n] @ s.H.T
    v = jw * periodic + grid.monomial_spectra @ plant.derivative(d_poly) + swinging[:, n : 2 * n] @ s.H.T
    q = _periodic_motion(forward, forces)
    slope = plant.derivative(q_poly)
    return Motions(
        deflection=d[:, : forward.elements],
        rate=v[:, : forward.elements],
        position=q + grid.monomial_spectra @ q_poly + swinging[:, :n],
        velocity=jw * q + grid.monomial_spectra @ slope + swinging[:, n : 2 * n],
        acceleration=jw**2 * q + grid.monomial_spectra @ plant.derivative(slope) + swinging @ A[n : 2 * n].T,
    )


def _periodic_motion(forward: Forward, forces: LawForces | None) -> ComplexArray:
    """Periodic part of the degrees of freedom, (F, n)."""
    return forward.linear_motion if forces is None else forward.linear_motion + forces.q


def particular_start(forward: Forward, forces: LawForces | None) -> FloatArray:
    """State (2n + b + f,) of the particular solution at the first sample; the free state is added to it."""
    plant, grid = forward.plant, forward.part.grid
    q = _periodic_motion(forward, forces)
    polynomial = forward.polynomial[0] + (0.0 if forces is None else forces.motion)
    position = grid.inverse(q)[0] + polynomial[0]
    rate = grid.inverse(1j * grid.omega[:, None] * q)[0] + plant.derivative(polynomial)[0]
    deflections = forward.linear_deflection + (0.0 if forces is None else forces.deflections)
    branches = grid.inverse(plant.structure.branch_forces(deflections, grid.omega))[0]
    return plant.structure.state(position, rate, branches)
