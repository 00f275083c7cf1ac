"""Free-running simulation of a system with laws of the catalogue in place.

The answer is split, x = x_linear + x_force.  The inputs' part is exact (model.simulate.stepping).  The laws' part
obeys the same linear system driven by the law forces alone and is integrated in short steps (model.simulate.etd),
all segments of the recording at once (model.simulate.segments).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.laws.base import ElementLaw
from sprung.model.laws.motion import CLOCK_LEAD, Motion, SpringDamper
from sprung.model.mechanics import ACCELERATION, FORCE, Mechanics
from sprung.model.signal_filters import firwin, upfirdn
from sprung.model.signals import FloatArray
from sprung.model.simulate.etd import ForceSteps, Site, force_steps
from sprung.model.simulate.segments import Solution, solve
from sprung.model.simulate.stepping import (
    cubic_chain,
    drive_columns,
    drive_positions,
    drive_vector,
    exact_steps,
)

_STEPS_PER_RADIAN = 5  # of the fastest mode
_STIFF = 0.5  # largest step times rate at which a law's slope pulls; explicit stages are stable up to 2.8
_MOST_PARTS = 64
_FILTER_REACH = 24  # samples to each side


@dataclass(frozen=True)
class Placement:
    """A law at its place: one element, the elements of an axle, or a left and a right one ("pair")."""

    law: ElementLaw
    elements: tuple[int, ...]
    p: tuple[float, ...]

    def weights(self, count: int) -> FloatArray:
        """Rows over the E elements: along which combination of deflections each force acts, (sites, E)."""
        rows = np.zeros((len(self.elements), count))
        rows[np.arange(len(self.elements)), self.elements] = 1.0
        return rows[:1] - rows[1:2] if self.law.where == "pair" else rows


class DiscreteSystem:
    """A system at given element values with laws in place, discretised: what runs and sensitivities share."""

    def __init__(self, mechanics: Mechanics, sample_rate: float, placements: tuple[Placement, ...], parts: int) -> None:
        self.mechanics, self.dt, self.parts, self.placements = mechanics, 1.0 / sample_rate, parts, placements
        self.A, self.B, self.C, self.D = mechanics.matrices()
        rows = [placement.weights(len(mechanics.stiffness)) for placement in placements]
        self.weights = np.vstack([np.zeros((0, len(mechanics.stiffness))), *rows])  # (L, E)
        self.exact = exact_steps(self.A, *drive_columns(mechanics, self.B), self.dt, 2 * parts)

    @property
    def names(self) -> list[tuple[str, tuple[int, ...]]]:
        """Which laws act where."""
        return [(placement.law.name, placement.elements) for placement in self.placements]

    @cached_property
    def steps(self) -> ForceSteps:
        return force_steps(self.A, self.force_columns, self.motion_rows, self.dt / self.parts)

    @cached_property
    def force_columns(self) -> FloatArray:
        """How the law forces change the states, (N, L)."""
        pull = -(self.weights @ self.mechanics.H).T / self.mechanics.mass[:, None]
        return np.vstack([np.zeros_like(pull), pull])

    @cached_property
    def motion_rows(self) -> FloatArray:
        """Deflections, then rates, of the sites by the states, (2L, N)."""
        rows = self.weights @ self.mechanics.H
        zero = np.zeros_like(rows)
        return np.vstack([np.hstack([rows, zero]), np.hstack([zero, rows])])

    @cached_property
    def motion_inputs(self) -> FloatArray:
        """The same by the chains of the supports, (2L, 4K)."""
        m, L = self.mechanics, len(self.weights)
        values, _ = drive_positions(m)
        at = np.searchsorted(values, m.support_drive)
        rows = np.zeros((2 * L, 4 * len(values)))
        rows[:L, at] = self.weights @ m.G
        rows[L:, len(values) + at] = self.weights @ m.G / self.dt
        return rows

    @cached_property
    def force_outputs(self) -> FloatArray:
        """What the sensors show of the law forces at once, (S, L)."""
        m = self.mechanics
        kind = m.sensor_kind[:, None]
        accelerations = -(m.S / m.mass) @ (self.weights @ m.H).T
        return np.where(kind == ACCELERATION, accelerations, 0) + np.where(kind == FORCE, m.L @ self.weights.T, 0)

    def known_motion(self, linear: FloatArray, chain: FloatArray) -> FloatArray:
        """Deflections and rates of the sites by the inputs' part, (fine grid, 2L, V)."""
        return self.exact.fine(np.hstack([self.motion_rows, self.motion_inputs]), linear, chain)

    def sites(self, placements: Sequence[Placement] | None = None) -> list[Site]:
        """One site per force, with the element's values (the mean of a pair's)."""
        found = []
        for placement in self.placements if placements is None else placements:
            groups = [placement.elements] if placement.law.where == "pair" else [(e,) for e in placement.elements]
            for group in groups:
                k, c = (values[list(group)].mean() for values in (self.mechanics.stiffness, self.mechanics.damping))
                found.append(Site(placement.law, placement.p, SpringDamper(float(k), float(c))))
        return found


@dataclass(frozen=True)
class NonlinearRun:
    """One simulated recording."""

    outputs: FloatArray  # what sensors show behind their anti-alias filter, without noise, (T, S)
    states: FloatArray  # (T, N)
    deflection: FloatArray  # of every element, m, (T, E)
    rate: FloatArray  # m/s, (T, E)
    force: FloatArray  # of the law at every site, N, (T, L)
    model: DiscreteSystem
    solution: Solution  # the laws' part alone


class NonlinearSimulator:
    """Simulates one system; `parts` integration steps per sample, as the modes and laws need if left out."""

    def __init__(self, mechanics: Mechanics, sample_rate: float, *, parts: int | None = None) -> None:
        self.mechanics, self.sample_rate, self.parts = mechanics, sample_rate, parts

    def run(
        self,
        knots: FloatArray,
        placements: Sequence[Placement],
        *,
        stiffness: FloatArray | None = None,
        damping: FloatArray | None = None,
        mass: FloatArray | None = None,
        x0: FloatArray | None = None,
        start: float = CLOCK_LEAD,
    ) -> NonlinearRun:
        """Simulate a recording.

        knots (T, 2K): value and slope of every drive at the samples, in the order of u.  stiffness, damping (E,) and
        mass (n,) replace the nominal values; x0 (N,) is the state at the first sample, at rest if left out.
        `start` is the laws' clock there.
        """
        mechanics = replace(
            self.mechanics,
            stiffness=self.mechanics.stiffness if stiffness is None else np.asarray(stiffness, dtype=float),
            damping=self.mechanics.damping if damping is None else np.asarray(damping, dtype=float),
            mass=self.mechanics.mass if mass is None else np.asarray(mass, dtype=float),
        )
        first = np.zeros(2 * mechanics.n) if x0 is None else np.asarray(x0, dtype=float)
        chain = cubic_chain(knots, 1 / self.sample_rate)[..., None]
        parts = self.parts or _parts_for_modes(mechanics, self.sample_rate)
        model = DiscreteSystem(mechanics, self.sample_rate, tuple(placements), parts)
        linear = model.exact.path(chain, first[:, None])
        known = model.known_motion(linear, chain)
        if self.parts is None and (needed := _parts_for_laws(model, known[..., 0], start)) > parts:
            model = DiscreteSystem(mechanics, self.sample_rate, model.placements, needed)
            known = model.known_motion(linear, chain)
        solution = solve(model.steps, model.exact.transition, model.sites(), known, parts=model.parts, start=start)
        return _assemble(model, knots, linear[..., 0], solution)


def _assemble(model: DiscreteSystem, knots: FloatArray, linear: FloatArray, solution: Solution) -> NonlinearRun:
    m = model.mechanics
    states = linear + solution.states[..., 0]
    u, fine = drive_vector(m, knots), solution.force[..., 0]
    shown = band_limited(fine, model.parts)
    return NonlinearRun(
        outputs=states @ model.C.T + u @ model.D.T + shown @ model.force_outputs.T,
        states=states,
        deflection=states[:, : m.n] @ m.H.T + u[:, m.support_drive] @ m.G.T,
        rate=states[:, m.n :] @ m.H.T + u[:, m.support_drive + 1] @ m.G.T,
        force=fine[:: model.parts],
        model=model,
        solution=solution,
    )


def band_limited(fine: FloatArray, parts: int) -> FloatArray:
    """A signal on the fine grid, ((T-1) parts + 1, L), behind an anti-alias filter, at the samples (T, L).

    Forces with jumps and kinks reach beyond half the sample rate; sampled as they are, that part would fold back.
    Of what the sensors show only the forces' direct share needs it: the states' share falls off faster by 1 / omega.
    Zero phase (the delay of real filters is common to all channels), -6 dB at half the sample rate.
    """
    if parts == 1 or not fine.shape[1]:
        return fine[::parts]
    reach = _FILTER_REACH * parts
    taps = firwin(2 * reach + 1, 1 / parts, window=("kaiser", 8.0))
    padded = np.concatenate([np.repeat(fine[:1], reach, axis=0), fine, np.repeat(fine[-1:], reach, axis=0)])
    return np.stack([upfirdn(taps, column, down=parts)[2 * _FILTER_REACH :] for column in padded.T], axis=1)[
        : (len(fine) - 1) // parts + 1
    ]


def _parts_for_modes(mechanics: Mechanics, sample_rate: float) -> int:
    """Steps per sample that follow the fastest undamped mode."""
    A, *_ = mechanics.matrices()
    fastest = np.sqrt(np.abs(np.linalg.eigvals(A[mechanics.n :, : mechanics.n])).max(initial=0.0))
    return _power_of_two(_STEPS_PER_RADIAN * fastest / sample_rate)


def _parts_for_laws(model: DiscreteSystem, known: FloatArray, start: float) -> int:
    """Steps per sample at which the steepest slopes of the laws are followed stably."""
    L = len(model.weights)
    time = start + np.arange(len(known)) * model.dt / (2 * model.parts)
    compliance = -np.einsum("ln,nl->l", model.motion_rows[L:], model.force_columns)  # 1/kg at every site
    fastest = 0.0
    for i, site in enumerate(model.sites()):
        d, v = known[:, i], known[:, L + i]
        memory = site.law.memory_start(Motion(d, v, time), site.p, site.element)
        memory = np.broadcast_to(memory, (site.law.memory, len(d)))
        small = 1e-4 * np.abs(v).max(initial=1e-12)
        there, back = (
            site.law.force(Motion(d, v + shift, time, memory), site.p, site.element) for shift in (small, -small)
        )
        slope = np.abs(there - back).max(initial=0.0) / (2 * small)
        fastest = max(fastest, compliance[i] * slope)
        if site.law.turns_over is not None:
            fastest = max(fastest, float(np.abs(v).max(initial=0.0) / np.min(site.law.turns_over(site.p))))
    return _power_of_two(fastest * model.dt / _STIFF)


def _power_of_two(parts: float) -> int:
    return int(min(2 ** math.ceil(math.log2(max(parts, 1.0))), _MOST_PARTS))
