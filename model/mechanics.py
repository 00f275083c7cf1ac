"""Assembly of a lumped system: M q'' + C q' + K q = loads, linear in masses, stiffnesses and dampings.

    deflection      d = H q + G s            (E,)  s: displacements of the moving supports
    element force   f = k d + c d'           (E,)  positive in extension
    equations       M q'' = -H^T f + F p     (n,)  p: measured forces
    sensors         accelerations etc. of points, deflections or forces of elements

States are x = [q, q'] with q ordered [z, roll, pitch] body by body.  The drive vector of the state equations is
u = [s1, s1', s2, s2', ..., p1, ...] in the order of the file's inputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sprung.model.schema import GROUND, Body, ElementSensor, ForceInput, SystemFile
from sprung.model.sensor_kinds import KINDS, Shown
from sprung.model.signals import FloatArray, IntArray

ACCELERATION, VELOCITY, DISPLACEMENT, DEFLECTION, FORCE = range(5)
_HELD = 1e-9  # of the largest stiffness: less holds nothing
_ROWS: dict[Shown, int] = {
    "acceleration": ACCELERATION,
    "velocity": VELOCITY,
    "displacement": DISPLACEMENT,
    "deflection": DEFLECTION,
    "force": FORCE,
}


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of free vibration."""

    frequency: float  # undamped natural frequency, Hz
    damping_ratio: float  # share of critical damping
    shape: FloatArray  # displacements, largest entry 1, shape (n,), complex magnitude with sign
    body: str  # the body that moves most (kinetic energy)


def state_matrix(mass: FloatArray, stiffness: FloatArray, damping: FloatArray) -> FloatArray:
    """A (2n, 2n) of x' = A x for a diagonal mass (n,), stiffness and damping matrices (n, n)."""
    n = len(mass)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:, :n] = -stiffness / mass[:, None]
    A[n:, n:] = -damping / mass[:, None]
    return A


def element_outputs(
    kind: IntArray, L: FloatArray, stiffness: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What sensors of elements show per deflection and per rate of the elements, each (S, E)."""
    of_deflection = np.where(kind[:, None] == FORCE, L * stiffness, np.where(kind[:, None] == DEFLECTION, L, 0.0))
    return of_deflection, np.where(kind[:, None] == FORCE, L * damping, 0.0)


def state_outputs(
    kind: IntArray, S: FloatArray, H: FloatArray, A: FloatArray, of_elements: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Sensors over the state, (S, states): C of the state equations.

    A (states, states): of [q, q', further states]; S (S, n): motion sensors over q; H (E, n): deflections over q.
    """
    n = S.shape[1]
    rows = np.where(kind[:, None] == ACCELERATION, S @ A[n : 2 * n], 0.0)
    rows[:, n : 2 * n] += np.where(kind[:, None] == VELOCITY, S, 0.0)
    rows[:, :n] += np.where(kind[:, None] == DISPLACEMENT, S, 0.0)
    rows[:, :n] += of_elements[0] @ H
    rows[:, n : 2 * n] += of_elements[1] @ H
    return rows


@dataclass(frozen=True, slots=True)
class Mechanics:
    """The constant matrices of a system; element values and masses multiply them."""

    dofs: tuple[str, ...]  # "car.z", "car.roll", ..., n of them
    body_of_dof: IntArray  # index of the body, shape (n,); -1: of none of the file's
    centre: FloatArray  # x and y of each body's own position, m, shape (bodies, 2)
    mass: FloatArray  # nominal mass or inertia of each degree of freedom, shape (n,)
    stiffness: FloatArray  # nominal, N/m, shape (E,)
    damping: FloatArray  # nominal, N s/m, shape (E,)
    H: FloatArray  # deflection per degree of freedom, shape (E, n)
    G: FloatArray  # deflection per support displacement, shape (E, supports)
    F: FloatArray  # generalised force per measured force, shape (n, forces)
    S: FloatArray  # motion sensors: row over degrees of freedom; zero for element sensors, shape (S, n)
    L: FloatArray  # element sensors: row over elements, shape (S, E)
    sensor_kind: IntArray  # ACCELERATION .. FORCE, shape (S,)
    support_drive: IntArray  # index in u of each support's displacement (its rate follows), shape (supports,)
    force_drive: IntArray  # index in u of each force, shape (forces,)

    @property
    def n(self) -> int:
        return len(self.dofs)

    @property
    def drives(self) -> int:
        """Length of u."""
        return 2 * len(self.support_drive) + len(self.force_drive)

    def matrices(
        self, stiffness: FloatArray | None = None, damping: FloatArray | None = None, mass: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A (2n, 2n), B (2n, u), C (S, 2n), D (S, u) for given element values; nominal where left out."""
        k = self.stiffness if stiffness is None else stiffness
        c = self.damping if damping is None else damping
        m = self.mass if mass is None else mass
        n, H, G = self.n, self.H, self.G
        A = state_matrix(m, (H.T * k) @ H, (H.T * c) @ H)
        B = np.zeros((2 * n, self.drives))
        B[n:, self.support_drive] = -(H.T * k) @ G / m[:, None]
        B[n:, self.support_drive + 1] = -(H.T * c) @ G / m[:, None]
        B[n:, self.force_drive] = self.F / m[:, None]
        C, D = self._outputs(A, B, k, c)
        return A, B, C, D

    def _outputs(self, A: FloatArray, B: FloatArray, k: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        of_deflection, of_rate = element_outputs(self.sensor_kind, self.L, k, c)
        C = state_outputs(self.sensor_kind, self.S, self.H, A, (of_deflection, of_rate))
        D = np.where(self.sensor_kind[:, None] == ACCELERATION, self.S @ B[self.n :], 0)
        D[:, self.support_drive] += of_deflection @ self.G
        D[:, self.support_drive + 1] += of_rate @ self.G
        return C, D

    def modes(self, bodies: tuple[str, ...]) -> list[Mode]:
        """Modes at the nominal values, by rising frequency; rigid-body modes have frequency 0."""
        A, *_ = self.matrices()
        values, vectors = scipy.linalg.eig(A)
        found = []
        for i in np.argsort(np.abs(values)):
            if values[i].imag < 0:
                continue
            shape = vectors[: self.n, i]
            energy = self.mass * np.abs(shape) ** 2
            per_body = np.bincount(self.body_of_dof, energy, len(bodies))
            peak = shape[np.argmax(np.abs(shape))]
            omega = abs(values[i])
            ratio = -values[i].real / omega if omega > 0 else 0.0
            real_shape = np.real(shape / peak) if peak != 0 else np.zeros(self.n)
            found.append(Mode(omega / (2 * np.pi), ratio, real_shape, bodies[int(np.argmax(per_body))]))
        return found

    def unobservable_mode(self, bodies: tuple[str, ...]) -> Mode | None:
        """A mode that no sensor sees (Popov-Belevitch-Hautus test at the nominal values), or None."""
        A, _, C, _ = self.matrices()
        scale = np.concatenate([np.ones(self.n), np.full(self.n, max(1.0, np.abs(np.linalg.eigvals(A)).max()))])
        A = A * scale[None, :] / scale[:, None]
        C = C * scale[None, :]
        C = C / np.maximum(np.abs(C).max(axis=1, keepdims=True), 1e-300)
        A_norm = max(np.abs(A).max(), 1e-300)
        values = np.linalg.eigvals(A)
        for value in values:
            pencil = np.vstack([(value * np.eye(len(A)) - A) / A_norm, C])
            if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9:
                frequency = abs(value) / (2 * np.pi)
                return min(self.modes(bodies), key=lambda mode: abs(mode.frequency - frequency))
        return None


def assemble(file: SystemFile) -> Mechanics:
    """Mechanics of a checked system file."""
    freedom = _Freedom.of(file)
    forces = [source for source in file.inputs.values() if isinstance(source, ForceInput)]
    H, G = _deflections(file, freedom)
    S, L = _sensor_rows(file, freedom)
    support_drive, force_drive = _drives(file)
    kinds = [_ROWS[KINDS[sensor.kind].shows] for sensor in file.sensors.values()]
    F = [freedom.point(source.body, source.position) for source in forces]
    return Mechanics(
        dofs=freedom.dofs,
        body_of_dof=np.array(freedom.body_of_dof),
        centre=np.array([body.position for body in file.bodies.values()], dtype=float).reshape(-1, 2),
        mass=np.array(freedom.mass),
        stiffness=np.array([e.stiffness.value for e in file.elements.values()]),
        damping=np.array([e.damping.value for e in file.elements.values()]),
        H=H,
        G=G,
        F=np.array(F).reshape(len(F), len(freedom.dofs)).T,
        S=S,
        L=L,
        sensor_kind=np.array(kinds),
        support_drive=support_drive,
        force_drive=force_drive,
    )


@dataclass(frozen=True)
class _Freedom:
    """Degrees of freedom of a file's bodies: z of every one, roll and pitch of those with an inertia."""

    file: SystemFile
    dofs: tuple[str, ...]
    body_of_dof: tuple[int, ...]
    mass: tuple[float, ...]

    @classmethod
    def of(cls, file: SystemFile) -> _Freedom:
        axes = [
            (f"{name}.{axis}", index, inertia)
            for index, (name, body) in enumerate(file.bodies.items())
            for axis, inertia in (("z", body.mass.value), ("roll", body.roll_inertia), ("pitch", body.pitch_inertia))
            if inertia is not None
        ]
        return cls(file, tuple(a for a, _, _ in axes), tuple(i for _, i, _ in axes), tuple(m for _, _, m in axes))

    def point(self, name: str, position: tuple[float, float] | None) -> FloatArray:
        """Vertical motion of a point of a body as a row over degrees of freedom, (n,)."""
        body: Body = self.file.bodies[name]
        x, y = position if position is not None else body.position
        levers = {"z": 1.0, "roll": y - body.position[1], "pitch": x - body.position[0]}
        row = np.zeros(len(self.dofs))
        for axis, lever in levers.items():
            if f"{name}.{axis}" in self.dofs:
                row[self.dofs.index(f"{name}.{axis}")] = lever
        return row


def _deflections(file: SystemFile, freedom: _Freedom) -> tuple[FloatArray, FloatArray]:
    """Deflections of the elements over degrees of freedom (E, n) and over supports (E, supports)."""
    supports = [name for name, source in file.inputs.items() if not isinstance(source, ForceInput)]
    H = np.zeros((len(file.elements), len(freedom.dofs)))
    G = np.zeros((len(file.elements), len(supports)))
    for e, element in enumerate(file.elements.values()):
        for end, sign in ((element.upper, 1.0), (element.lower, -1.0)):
            if end in file.bodies:
                H[e] += sign * freedom.point(end, element.position)
            elif end != GROUND:
                G[e, supports.index(end)] += sign
    return H, G


def _sensor_rows(file: SystemFile, freedom: _Freedom) -> tuple[FloatArray, FloatArray]:
    """Sensors over degrees of freedom (S, n) and over elements (S, E)."""
    S = np.zeros((len(file.sensors), len(freedom.dofs)))
    L = np.zeros((len(file.sensors), len(file.elements)))
    elements = list(file.elements)
    for i, sensor in enumerate(file.sensors.values()):
        if isinstance(sensor, ElementSensor):
            L[i, elements.index(sensor.element)] = 1.0
        elif axis := KINDS[sensor.kind].axis:
            S[i, freedom.dofs.index(f"{sensor.body}.{axis}")] = 1.0
        else:
            S[i] = freedom.point(sensor.body, sensor.position)
    return S, L


def _drives(file: SystemFile) -> tuple[IntArray, IntArray]:
    """Indices in u of the supports' displacements, each with its rate behind it, and of the forces."""
    support_drive: list[int] = []
    force_drive: list[int] = []
    at = 0
    for source in file.inputs.values():
        (force_drive if isinstance(source, ForceInput) else support_drive).append(at)
        at += 1 if isinstance(source, ForceInput) else 2
    return np.array(support_drive, dtype=np.int64), np.array(force_drive, dtype=np.int64)


def rigid_body_modes(stiffness: FloatArray) -> FloatArray:
    """Zero-stiffness modes: motions (n, m) that a stiffness matrix (n, n) does not hold."""
    values, shapes = np.linalg.eigh(stiffness)
    return np.asarray(shapes[:, np.abs(values) <= _HELD * max(float(np.abs(values).max()), 1e-300)])
