"""Frequency responses of a system from unmeasured sources to its sensors, with what its unknowns change in them.

A change of an element's stiffness or damping acts as a force along the element equal to its change of force, a change
of mass as a force on the degree of freedom: every sensitivity is a column (signals per such force) times a row (motion
there per source) times a factor, so that one inverse of the dynamic stiffness per frequency serves all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.sensing import Sensing
from sprung.model.mechanics import ACCELERATION, DEFLECTION, FORCE, VELOCITY, Mechanics
from sprung.model.parameters import Parameter
from sprung.model.ratios import parameter_powers
from sprung.model.signals import FloatArray
from sprung.model.system import System


@dataclass(frozen=True, slots=True)
class Response:
    """At F frequencies: R signals of the sensors, X sources, P unknowns, K places of forces (elements, then masses)."""

    signals: np.ndarray  # per unit of every source, shape (F, R, X)
    per_force: np.ndarray  # signals per unit force at each place, shape (F, R, K)
    motion: np.ndarray  # at each place per unit of every source, shape (F, K, X)
    factor: np.ndarray  # force at each place per motion there and per log-ratio, shape (F, P, K)


_DERIVATIVE = {"stiffness": 0, "damping": 1, "mass": 2}


class Responses:
    """Responses of one system; the sources are all its supports (m), or forces (N) on all degrees of freedom."""

    def __init__(self, system: System, sensing: Sensing, loads: Sequence[str] = ()) -> None:
        """loads: bodies whose mass and inertias vary together beside the system's own parameters."""
        m = system.mechanics
        self.mechanics: Mechanics = m
        self.sensing = sensing
        self.supported = m.G.shape[1] > 0
        self.unknowns = (*system.parameters, *(_load(system, body) for body in loads))
        powers, none = parameter_powers(system), np.zeros(len(m.stiffness))
        of_loads = [np.append(none, m.body_of_dof == system.bodies.index(body)) for body in loads]
        of_parameters = np.concatenate([powers.stiffness + powers.damping, powers.mass], axis=1)
        # Elements and masses that an unknown scales, (P + loads, E + n)
        self.place = np.concatenate([of_parameters, *(row[None] for row in of_loads)])
        # 0: of motion, 1: of its rate, 2: of acceleration
        self.derivative = np.array([_DERIVATIVE.get(unknown.quantity, 0) for unknown in self.unknowns], dtype=int)

    def values(self, log_ratio: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Stiffnesses, dampings (E,) and masses (n,) of log-ratios (P,)."""
        m, scale = self.mechanics, np.exp(log_ratio[:, None] * self.place)
        E = len(m.stiffness)
        k, c, mass = (scale[self.derivative == d].prod(axis=0) for d in range(3))
        return m.stiffness * k[:E], m.damping * c[:E], m.mass * mass[E:]

    def at(self, log_ratio: FloatArray, omega: FloatArray) -> Response:
        """Responses at angular frequencies (F,), rad/s."""
        m = self.mechanics
        k, c, mass = self.values(log_ratio)
        jw = 1j * omega
        dynamic = k + jw[:, None] * c  # force per deflection, (F, E)
        Z = (m.H.T * dynamic[:, None, :]) @ m.H
        diagonal = np.arange(m.n)
        Z[:, diagonal, diagonal] -= omega[:, None] ** 2 * mass
        compliance: np.ndarray = np.linalg.inv(Z)
        seen = self.sensing
        of_deflection = np.where((seen.kind == DEFLECTION)[:, None], seen.elements, 0.0)
        direct = np.where((seen.kind == FORCE)[:, None], seen.elements, 0.0)
        order = np.where(seen.kind == ACCELERATION, 2, np.where(seen.kind == VELOCITY, 1, 0))
        through = of_deflection + direct * dynamic[:, None, :]  # signals per deflection, (F, R, E)
        sensing = jw[:, None, None] ** order[:, None] * seen.motion + through @ m.H
        per_load = sensing @ compliance  # (F, R, n)
        per_force = np.concatenate([direct - per_load @ m.H.T, per_load], axis=2)
        if self.supported:
            motion = compliance @ -((m.H.T * dynamic[:, None, :]) @ m.G)
            signals = sensing @ motion + through @ m.G
            stretch = m.H @ motion + m.G
        else:
            motion, signals, stretch = compliance, per_load, m.H @ compliance
        rise = np.stack([np.ones_like(jw), jw, omega.astype(complex) ** 2])  # of a mass: -(-w^2 m)
        size = np.array([np.concatenate([k, 0 * mass]), np.concatenate([c, 0 * mass]), np.concatenate([0 * k, mass])])
        factor = rise[self.derivative].T[:, :, None] * (self.place * size[self.derivative])
        return Response(signals, per_force, np.concatenate([stretch, motion], axis=1), factor)


def _load(system: System, body: str) -> Parameter:
    return Parameter(f"{body}.load", body, "mass", "kg", system.file.bodies[body].mass.value)
