"""The linear system as frequency responses on the bins of one record part.

    (-w^2 M + H^T (k + j w c) H) q = -H^T ((k + j w c) G s + f) + F p + l

q degrees of freedom, s moving supports, p measured forces, f forces of laws along the elements, l loads on degrees of
freedom.  Letters: F bins, S sensors, E elements, n degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import expm

from sprung.model.diagnosis.record.spectra import DEGREE, ComplexArray, Grid, derivative
from sprung.model.diagnosis.response.structure import Structure
from sprung.model.laws.channel import FilterSection
from sprung.model.mechanics import ACCELERATION, DEFLECTION, DISPLACEMENT, FORCE, VELOCITY, rigid_body_modes
from sprung.model.signals import FloatArray

_ON_A_BIN = 1e-9  # distance of an undamped mode from a bin on the unit circle
_DEFECTIVE = 1e9  # condition number of the modes beyond which they count as defective


@dataclass(frozen=True)
class Plant:
    """Frequency responses of a structure on a grid."""

    structure: Structure
    grid: Grid

    def behind(self, filters: tuple[tuple[int, FilterSection], ...]) -> Plant:
        """The same system behind other filters of its sensors, which change nothing but the free motion."""
        other = Plant(replace(self.structure, filters=filters), self.grid)
        other.__dict__.update({name: value for name, value in self.__dict__.items() if name in _UNFILTERED})
        return other

    @cached_property
    def impedance(self) -> ComplexArray:
        """Dynamic stiffness of each element with its branches, k + j w c + ..., N/m, (F, E)."""
        s = self.structure
        result: ComplexArray = s.stiffness + 1j * self.grid.omega[:, None] * s.damping
        for branch in s.branches:
            result[:, branch.element] += branch.impedance(self.grid.omega)
        return result

    @property
    def dynamic_stiffness(self) -> ComplexArray:
        """Load per displacement, N/m, shape (F, n, n)."""
        s, w = self.structure, self.grid.omega
        n = len(s.mass)
        outer = (s.H[:, :, None] * s.H[:, None, :]).reshape(len(s.H), n * n)
        Z = (self.impedance @ outer).reshape(len(w), n, n)
        index = np.arange(n)
        Z[:, index, index] += s.modal_stiffness + 1j * w[:, None] * s.modal_damping - w[:, None] ** 2 * s.mass
        found: ComplexArray = Z
        return found

    @cached_property
    def receptance(self) -> ComplexArray:
        """Displacement per load, m/N, shape (F, n, n); zero at zero frequency where the system is unconstrained."""
        Z = self.dynamic_stiffness
        if np.linalg.cond(Z[0].real) > 1e12:
            result = np.zeros_like(Z)
            result[1:] = np.linalg.inv(Z[1:])
            return result
        return np.linalg.inv(Z)

    @property
    def floats(self) -> bool:
        """Whether the system is unconstrained: it has rigid-body modes without stiffness."""
        return not np.any(self.receptance[0])

    def line_motion(self, port: FloatArray) -> FloatArray:
        """Polynomial responses to a constant unit force along a port and to a linear one that rises to 1.

        (2, DEGREE + 1, n)
        """
        load = np.zeros((2, DEGREE + 1, self.structure.H.shape[1]))
        for k in range(2):
            load[k, k] = -port @ self.structure.H
        return np.array([self.polynomial_response(one) for one in load])

    def without_line(self, spectrum: ComplexArray) -> tuple[ComplexArray, FloatArray]:
        """A force's spectrum (F, m) without its mean and the line through its ends, and their sizes (2, m)."""
        series = self.grid.inverse(spectrum)
        slope = 2 * series[-1] - series[-2] - series[0]
        mean = (series - self.grid.monomials[:, 1:2] * slope).mean(axis=0)
        line = np.stack([mean, slope])
        return spectrum - self.grid.monomial_spectra[:, :2] @ line, line

    @cached_property
    def sensor_of_dof(self) -> ComplexArray:
        """Sensor signal per degree of freedom, shape (F, S, n); moving supports left out."""
        s, w = self.structure, self.grid.omega[:, None, None]
        kind = s.sensor_kind[:, None]
        jw: ComplexArray = 1j * w
        result = np.asarray(np.where(kind == ACCELERATION, jw**2, np.where(kind == VELOCITY, jw, 1.0)) * s.S, complex)
        if np.any(s.L):
            return result + self._of_deflection @ s.H
        return result

    @cached_property
    def _of_deflection(self) -> ComplexArray:
        """Sensor signal per deflection of an element, shape (F, S, E)."""
        s = self.structure
        kind = s.sensor_kind[:, None]
        return np.where(kind == FORCE, s.L * self.impedance[:, None, :], np.where(kind == DEFLECTION, s.L, 0.0))

    @cached_property
    def sensor_of_load(self) -> ComplexArray:
        """Sensor signal per load on a degree of freedom, shape (F, S, n)."""
        result = self.sensor_of_dof @ self.receptance
        if self.floats:
            s = self.structure
            result[0] = np.where(s.sensor_kind[:, None] == VELOCITY, s.S @ self.steady_rate, 0.0)
        return result

    @cached_property
    def steady_rate(self) -> FloatArray:
        """Velocity of damped rigid-body modes under a steady unit load, (n, n)."""
        s = self.structure
        rigid = rigid_body_modes(s.K)
        return rigid @ np.linalg.pinv(rigid.T @ s.C @ rigid, rcond=1e-9) @ rigid.T

    @cached_property
    def sensor_of_force(self) -> ComplexArray:
        """Sensor signal per law force along an element, shape (F, S, E)."""
        s = self.structure
        load = self.sensor_of_load
        result = (load.reshape(-1, len(s.mass)) @ -s.H.T).reshape(*load.shape[:2], len(s.H))
        if np.any(s.L):
            result = result + np.where(s.sensor_kind[:, None] == FORCE, s.L, 0.0)
        return result

    def deflection_of_load(self, ports: FloatArray) -> ComplexArray:
        """Deflection along ports (m, E) per load on a degree of freedom, shape (F, m, n)."""
        return (ports @ self.structure.H) @ self.receptance

    def compliance(self, ports: FloatArray, sources: FloatArray) -> ComplexArray:
        """Deflection along ports (m, E) per law force along sources (s, E), shape (F, m, s)."""
        return -(self.deflection_of_load(ports) @ (sources @ self.structure.H).T)

    def load(self, support: ComplexArray, force: ComplexArray) -> ComplexArray:
        """Load on the degrees of freedom under supports (F, supports) and measured forces (F, forces), (F, n)."""
        s = self.structure
        return np.asarray(force @ s.F.T - ((support @ s.G.T) * self.impedance) @ s.H)

    def sensors(self, support: ComplexArray, force: ComplexArray) -> ComplexArray:
        """True signals under supports (F, supports) and measured forces (F, forces), (F, S)."""
        s = self.structure
        result = np.einsum("fsn,fn->fs", self.sensor_of_load, self.load(support, force))
        if np.any(s.L):
            result += np.einsum("fse,fe->fs", self._of_deflection, support @ s.G.T)
        found: ComplexArray = result
        return found

    def sensors_once(self, support: ComplexArray, force: ComplexArray) -> ComplexArray:
        """As `sensors`, on a grid without zero frequency, by one solution: cheaper if nothing else is needed."""
        s = self.structure
        motion = np.linalg.solve(self.dynamic_stiffness, self.load(support, force)[:, :, None])
        result = (self.sensor_of_dof @ motion)[:, :, 0]
        if np.any(s.L):
            result += np.einsum("fse,fe->fs", self._of_deflection, support @ s.G.T)
        found: ComplexArray = result
        return found

    @property
    def load_of_support(self) -> ComplexArray:
        """Load on the degrees of freedom per support displacement, shape (F, n, supports)."""
        s = self.structure
        return -(self.impedance[:, None, :] * s.H.T) @ s.G

    @cached_property
    def sensor_of_support(self) -> ComplexArray:
        """Sensor signal per support displacement, shape (F, S, supports)."""
        s = self.structure
        result = self.sensor_of_load @ self.load_of_support
        if np.any(s.L):
            result = result + self._of_deflection @ s.G
        return result

    @cached_property
    def sensor_of_measured_force(self) -> ComplexArray:
        """Sensor signal per measured force, shape (F, S, forces)."""
        return self.sensor_of_load @ self.structure.F

    @cached_property
    def deflection_of_inputs(self) -> ComplexArray:
        """Deflection of each element per support displacement and measured force, shape (F, E, inputs)."""
        s = self.structure
        result = s.H @ (self.receptance @ self.load_of_inputs)
        result[:, :, : s.G.shape[1]] += s.G
        return result

    @property
    def load_of_inputs(self) -> ComplexArray:
        """Load on the degrees of freedom per support displacement and measured force, shape (F, n, inputs)."""
        load, F = self.load_of_support, self.structure.F
        return np.concatenate([load, np.broadcast_to(F, (len(load), *F.shape))], axis=2)

    def polynomial_response(self, load: FloatArray) -> FloatArray:
        """Polynomial motion q under polynomial loads on the degrees of freedom.

        Coefficients over t / length: load (DEGREE + 1, n) -> q (DEGREE + 1, n), by matching powers of t.
        """
        return (self._polynomial_answers @ load.reshape(-1)).reshape(load.shape)

    @cached_property
    def _polynomial_answers(self) -> FloatArray:
        """Coefficients of motion per coefficient of load, both flattened; the least-norm solution where not unique."""
        s, T = self.structure, self.grid.length
        p = DEGREE + 1
        first = np.diag(np.arange(1, p), 1) / T  # coefficients of the derivative
        system = np.kron(np.eye(p), s.K) + np.kron(first, s.steady_C) + np.kron(first @ first, np.diag(s.mass))
        scale = np.abs(system).max(axis=1)
        scale[scale == 0] = 1.0
        columns = np.tile(1 / np.sqrt(np.maximum(np.abs(np.diag(s.K)), s.mass / T**2)), p)
        inverse = np.linalg.pinv(system * columns / scale[:, None], rcond=1e-13)
        return np.asarray(columns[:, None] * inverse / scale)

    def polynomial_sensors(self, q: FloatArray, support: FloatArray, law: FloatArray | float = 0.0) -> FloatArray:
        """Sensor polynomials, (DEGREE + 1, S).

        From motion (DEGREE + 1, n), supports (DEGREE + 1, supports), and forces of laws along the elements
        (DEGREE + 1, E), which load cells show directly.
        """
        s = self.structure
        q1, d = self.derivative(q), q @ s.H.T + support @ s.G.T
        kind = s.sensor_kind
        result = np.where(kind == ACCELERATION, self.derivative(q1) @ s.S.T, 0.0)
        result += np.where(kind == VELOCITY, q1 @ s.S.T, 0.0) + np.where(kind == DISPLACEMENT, q @ s.S.T, 0.0)
        force = d * s.stiffness + self.derivative(d) * s.steady_damping + law
        result += np.where(kind == DEFLECTION, d @ s.L.T, 0.0) + np.where(kind == FORCE, force @ s.L.T, 0.0)
        return result

    def derivative(self, polynomial: FloatArray) -> FloatArray:
        """Time derivative of polynomials over t / length, (DEGREE + 1, ...)."""
        return derivative(polynomial, self.grid.length)

    @cached_property
    def _free_modes(self) -> tuple[ComplexArray, ComplexArray, ComplexArray] | None:
        """Modes of the free motion (2n, 2n), transforms of their decays (F, 2n), and the modes' inverse.

        sum_k l^k z^-k = (1 - l^N) / (1 - l / z); None for defective modes.
        """
        grid = self.grid
        values, vectors = np.linalg.eig(self.structure.state_matrix())
        if np.linalg.cond(vectors) > _DEFECTIVE:
            return None
        left = 1 - np.exp(-1j * grid.omega * grid.step)[:, None] * np.exp(values * grid.step)
        near = np.abs(left) < _ON_A_BIN
        decays = np.where(near, grid.samples, (1 - np.exp(values * grid.length)) / np.where(near, 1.0, left))
        return vectors, decays / np.sqrt(grid.samples), np.linalg.inv(vectors)

    def free_transforms(self, rows: FloatArray) -> ComplexArray:
        """Transforms of rows e^{A t} over the samples: (m, 2n) -> (F, m, 2n)."""
        if self._free_modes is None:
            return self.grid.forward(self.free_motion(rows, self.grid.step, self.grid.samples))
        vectors, decays, inverse = self._free_modes
        modal = (rows @ vectors).T[:, :, None] * inverse[:, None, :]  # (2n, m, 2n)
        columns = decays @ modal.reshape(len(modal), -1)  # one product for all bins
        found: ComplexArray = columns.reshape(len(decays), *modal.shape[1:])
        return found

    def free_transform(self, rows: FloatArray, state: FloatArray) -> ComplexArray:
        """Transforms of rows e^{A t} state over the samples: (m, 2n), (2n,) -> (F, m)."""
        if self._free_modes is None:
            return np.asarray(self.free_transforms(rows) @ state)
        vectors, decays, inverse = self._free_modes
        return np.asarray(decays @ ((inverse @ state)[:, None] * (rows @ vectors).T))

    def free_motion(self, rows: FloatArray, step: float, count: int) -> FloatArray:
        """rows e^{A t} at t = 0, step, ...: (m, 2n) -> (count, m, 2n), by doubling."""
        power = expm(self.structure.state_matrix() * step)
        result = np.empty((count, *rows.shape))
        result[0] = rows
        done = 1
        while done < count:
            more = min(done, count - done)
            result[done : done + more] = result[:more] @ power
            power = power @ power
            done += more
        return result


_UNFILTERED = {name for name, value in vars(Plant).items() if isinstance(value, cached_property)} - {"_free_modes"}
