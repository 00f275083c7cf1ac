"""Matrices of the linear system with laws of bodies and Maxwell branches in place, and its state equations."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.mechanics import FORCE, Mechanics, element_outputs, state_matrix, state_outputs
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Branch:
    """A spring and a damper in series beside an element, force s' = stiffness v - s / time (Maxwell)."""

    element: int
    stiffness: float  # N/m
    time: float  # s, damper over spring
    replaces: float = 0.0  # N s/m, what of the element's damper is in the branch
    of_spring: bool = False  # whether its stiffness is a share of the element's own

    def impedance(self, omega: FloatArray) -> ComplexArray:
        """What the branch adds to k + j w c, N/m, (F,)."""
        jw = 1j * omega
        return np.asarray(jw * self.per_rate(omega))

    def per_rate(self, omega: FloatArray) -> ComplexArray:
        """The same per rate, N s/m, (F,): the rate of a motion whose ends do not meet has a spectrum of its own."""
        return np.asarray(self.stiffness * self.time / (1 + 1j * omega * self.time) - self.replaces)


@dataclass(frozen=True)
class Structure:
    """Matrices and values of a system, possibly with elastic modes appended as further degrees of freedom.

    State of the free motion: [q, q', forces of the branches], 2n + b.
    """

    mass: FloatArray  # (n,)
    stiffness: FloatArray  # (E,)
    damping: FloatArray  # (E,)
    own_stiffness: FloatArray  # of elastic modes against their body, (n,)
    own_damping: FloatArray  # (n,)
    H: FloatArray  # (E, n)
    G: FloatArray  # (E, supports)
    F: FloatArray  # (n, forces)
    S: FloatArray  # (S, n)
    L: FloatArray  # (S, E)
    sensor_kind: np.ndarray  # (S,)
    body_of_dof: np.ndarray  # (n,), -1 for an elastic mode
    branches: tuple[Branch, ...] = ()  # b of them

    @classmethod
    def nominal(cls, mechanics: Mechanics, sensors: np.ndarray) -> Structure:
        """The structure of the system file, seen by the sensors of the given indices."""
        n = mechanics.n
        return cls(
            mass=mechanics.mass,
            stiffness=mechanics.stiffness,
            damping=mechanics.damping,
            own_stiffness=np.zeros(n),
            own_damping=np.zeros(n),
            H=mechanics.H,
            G=mechanics.G,
            F=mechanics.F,
            S=mechanics.S[sensors],
            L=mechanics.L[sensors],
            sensor_kind=mechanics.sensor_kind[sensors],
            body_of_dof=mechanics.body_of_dof,
        )

    def same(self, other: Structure) -> bool:
        """Whether another structure has the same matrices and values."""
        pairs = ((getattr(self, one.name), getattr(other, one.name)) for one in fields(self) if one.name != "branches")
        return self.branches == other.branches and all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    @property
    def K(self) -> FloatArray:
        return (self.H.T * self.stiffness) @ self.H + np.diag(self.own_stiffness)

    @property
    def C(self) -> FloatArray:
        return (self.H.T * self.damping) @ self.H + np.diag(self.own_damping)

    @property
    def steady_C(self) -> FloatArray:
        return (self.H.T * self.steady_damping) @ self.H + np.diag(self.own_damping)

    @property
    def steady_damping(self) -> FloatArray:
        """Force per rate of the elements in steady motion, N s/m, (E,)."""
        damping = self.damping.copy()
        for branch in self.branches:
            damping[branch.element] += branch.stiffness * branch.time - branch.replaces
        return damping

    @property
    def states(self) -> int:
        return 2 * len(self.mass) + len(self.branches)

    def state_matrix(self) -> FloatArray:
        """A of the free motion, shape (2n + b, 2n + b)."""
        n = len(self.mass)
        A = np.zeros((self.states, self.states))
        A[: 2 * n, : 2 * n] = state_matrix(self.mass, self.K, self.C)
        for i, branch in enumerate(self.branches, 2 * n):
            h = self.H[branch.element]
            A[n : 2 * n, n : 2 * n] += branch.replaces * np.outer(h, h) / self.mass[:, None]
            A[n : 2 * n, i] = -h / self.mass
            A[i, n : 2 * n] = branch.stiffness * h
            A[i, i] = -1 / branch.time
        return A

    def widened(self, ports: FloatArray) -> FloatArray:
        """Weights (m, E) over the system's elements as weights over all elements here, elastic modes' included."""
        return np.pad(ports, ((0, 0), (0, len(self.H) - ports.shape[1])))

    def motion_rows(self, ports: FloatArray) -> FloatArray:
        """Deflections along ports (m, E), then their rates, over the state, (2m, 2n + b)."""
        along = ports @ self.H
        m, n = along.shape
        rows = np.zeros((2 * m, self.states))
        rows[:m, :n], rows[m:, n : 2 * n] = along, along
        return rows

    def force_columns(self, ports: FloatArray) -> FloatArray:
        """What forces along ports (m, E) do to the state's rate, (2n + b, m)."""
        n = len(self.mass)
        columns = np.zeros((self.states, len(ports)))
        columns[n : 2 * n] = -(ports @ self.H).T / self.mass[:, None]
        return columns

    def sensor_rows(self) -> FloatArray:
        """Sensors over the state of free motion, shape (S, 2n + b)."""
        n = len(self.mass)
        of_elements = element_outputs(self.sensor_kind, self.L, self.stiffness, self.damping)
        rows = state_outputs(self.sensor_kind, self.S, self.H, self.state_matrix(), of_elements)
        for i, branch in enumerate(self.branches, 2 * n):
            at = np.where(self.sensor_kind == FORCE, self.L[:, branch.element], 0.0)
            rows[:, n : 2 * n] -= np.outer(at * branch.replaces, self.H[branch.element])
            rows[:, i] += at
        return rows

    def branch_forces(self, deflections: ComplexArray, omega: FloatArray) -> ComplexArray:
        """Forces of the branches along periodic deflections (F, E), (F, b)."""
        jw = 1j * omega
        columns = [b.stiffness * b.time * jw / (1 + jw * b.time) * deflections[:, b.element] for b in self.branches]
        return np.stack(columns, axis=1) if columns else np.zeros((len(omega), 0), dtype=complex)
