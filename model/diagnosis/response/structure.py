"""Matrices and state equations of the linear system, with laws of bodies and Maxwell branches included."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.laws.channel import FilterSection
from sprung.model.mechanics import FORCE, Mechanics, element_outputs, state_matrix, state_outputs
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Branch:
    """Maxwell element parallel to an element: spring and damper in series, force s' = stiffness v - s / time."""

    element: int
    stiffness: float  # N/m
    time: float  # s, relaxation time: damper over spring
    replaces: float = 0.0  # N s/m, the part of the element's damper that the branch replaces
    of_spring: bool = False  # whether its stiffness is proportional to the element's

    def impedance(self, omega: FloatArray) -> ComplexArray:
        """Dynamic stiffness beside k + j w c, N/m, (F,); omega: rad/s, (F,)."""
        jw = 1j * omega
        return np.asarray(jw * self.per_rate(omega))

    def per_rate(self, omega: FloatArray) -> ComplexArray:
        """Force per rate, N s/m, (F,).  Rates of non-periodic motions have spectra of their own."""
        return np.asarray(self.stiffness * self.time / (1 + 1j * omega * self.time) - self.replaces)


@dataclass(frozen=True)
class Structure:
    """Matrices of a system, elastic modes appended as further degrees of freedom.

    State of the free motion: [q, q', forces of the branches, those of the sensors' filters], 2n + b + f.  SI units.
    """

    mass: FloatArray  # (n,)
    stiffness: FloatArray  # (E,)
    damping: FloatArray  # (E,)
    modal_stiffness: FloatArray  # of elastic modes, zero elsewhere, (n,)
    modal_damping: FloatArray  # (n,)
    H: FloatArray  # (E, n)
    G: FloatArray  # (E, supports)
    F: FloatArray  # (n, forces)
    S: FloatArray  # (S, n)
    L: FloatArray  # (S, E)
    sensor_kind: np.ndarray  # (S,)
    body_of_dof: np.ndarray  # (n,), -1 for an elastic mode
    branches: tuple[Branch, ...] = ()  # b of them
    filters: tuple[tuple[int, FilterSection], ...] = ()  # of the sensors, by their index, with f states together

    @classmethod
    def nominal(cls, mechanics: Mechanics, sensors: np.ndarray) -> Structure:
        """The structure of the system file with the sensors of the given indices (S,)."""
        n = mechanics.n
        return cls(
            mass=mechanics.mass,
            stiffness=mechanics.stiffness,
            damping=mechanics.damping,
            modal_stiffness=np.zeros(n),
            modal_damping=np.zeros(n),
            H=mechanics.H,
            G=mechanics.G,
            F=mechanics.F,
            S=mechanics.S[sensors],
            L=mechanics.L[sensors],
            sensor_kind=mechanics.sensor_kind[sensors],
            body_of_dof=mechanics.body_of_dof,
        )

    def same(self, other: Structure) -> bool:
        """Whether another structure is equal in all matrices and branches: filters do not move anything."""
        apart = ("branches", "filters")
        pairs = ((getattr(self, one.name), getattr(other, one.name)) for one in fields(self) if one.name not in apart)
        return self.branches == other.branches and all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    @property
    def K(self) -> FloatArray:
        return (self.H.T * self.stiffness) @ self.H + np.diag(self.modal_stiffness)

    @property
    def C(self) -> FloatArray:
        return (self.H.T * self.damping) @ self.H + np.diag(self.modal_damping)

    @property
    def steady_C(self) -> FloatArray:
        return (self.H.T * self.steady_damping) @ self.H + np.diag(self.modal_damping)

    @property
    def steady_damping(self) -> FloatArray:
        """Damping of the elements in steady motion, N s/m, (E,): branches relaxed."""
        damping = self.damping.copy()
        for branch in self.branches:
            damping[branch.element] += branch.stiffness * branch.time - branch.replaces
        return damping

    @property
    def moving(self) -> int:
        """States of the bodies and branches, without those of the sensors' filters."""
        return 2 * len(self.mass) + len(self.branches)

    @property
    def states(self) -> int:
        return self.moving + sum(section.order for _, section in self.filters)

    def state_matrix(self) -> FloatArray:
        """A of the free motion, shape (2n + b + f, 2n + b + f).

        The states of filters are those of their own free motion, beside their steady response to that of the bodies.
        """
        n = len(self.mass)
        A = np.zeros((self.states, self.states))
        A[: 2 * n, : 2 * n] = state_matrix(self.mass, self.K, self.C)
        for i, branch in enumerate(self.branches, 2 * n):
            h = self.H[branch.element]
            A[n : 2 * n, n : 2 * n] += branch.replaces * np.outer(h, h) / self.mass[:, None]
            A[n : 2 * n, i] = -h / self.mass
            A[i, n : 2 * n] = branch.stiffness * h
            A[i, i] = -1 / branch.time
        at = self.moving
        for _, section in self.filters:
            A[at : at + section.order, at : at + section.order] = section.companion()
            at += section.order
        return A

    def state(self, position: FloatArray, rate: FloatArray, branches: FloatArray) -> FloatArray:
        """State (2n + b + f,) of bodies and branches, with filters that show none of their own free motion."""
        return np.concatenate([position, rate, branches, np.zeros(self.states - self.moving)])

    def padded(self, ports: FloatArray) -> FloatArray:
        """Ports (m, E) over the system's elements, padded by zeros to those of this structure."""
        return np.pad(ports, ((0, 0), (0, len(self.H) - ports.shape[1])))

    def motion_rows(self, ports: FloatArray) -> FloatArray:
        """Output rows (2m, 2n + b + f): deflections along ports (m, E), then their rates."""
        along = ports @ self.H
        m, n = along.shape
        rows = np.zeros((2 * m, self.states))
        rows[:m, :n], rows[m:, n : 2 * n] = along, along
        return rows

    def force_columns(self, ports: FloatArray) -> FloatArray:
        """Input columns (2n + b + f, m) of forces along ports (m, E)."""
        n = len(self.mass)
        columns = np.zeros((self.states, len(ports)))
        columns[n : 2 * n] = -(ports @ self.H).T / self.mass[:, None]
        return columns

    def sensor_rows(self) -> FloatArray:
        """Output rows of the sensors in free motion, (S, 2n + b + f), without their filters."""
        n = len(self.mass)
        of_elements = element_outputs(self.sensor_kind, self.L, self.stiffness, self.damping)
        rows = state_outputs(self.sensor_kind, self.S, self.H, self.state_matrix(), of_elements)
        for i, branch in enumerate(self.branches, 2 * n):
            at = np.where(self.sensor_kind == FORCE, self.L[:, branch.element], 0.0)
            rows[:, n : 2 * n] -= np.outer(at * branch.replaces, self.H[branch.element])
            rows[:, i] += at
        return rows

    def branch_forces(self, deflections: ComplexArray, omega: FloatArray) -> ComplexArray:
        """Forces of the branches, N, (F, b), along periodic deflections (F, E), m; omega: rad/s, (F,)."""
        jw = 1j * omega
        columns = [b.stiffness * b.time * jw / (1 + jw * b.time) * deflections[:, b.element] for b in self.branches]
        return np.stack(columns, axis=1) if columns else np.zeros((len(omega), 0), dtype=complex)
