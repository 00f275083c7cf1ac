"""Sensitivities of a simulated recording to element values, masses, law parameters and the first state.

A small change makes a small motion y around the run.  A change of k_e acts like a force k_e d_e along element e, one
of c_e like c_e v_e, one of a mass like -m q''; the laws answer with their tangents along the run:

    x' = A x + b f + (forces of the change),   f = J_y y + J_z z + r_f,   z' = M_y y + M_z z + r_m

All of it is linear, so every segment of the recording is propagated once, for all changes and for a basis of first
states at the same time, and the segments are joined by superposition: no iteration.  The forces' own linear answer is
exact; the laws' answer is the exponential trapezoidal rule (implicit in f and z, so stable for stiff laws).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.diagnosis.catalogue.base import Motion, SpringDamper, Values
from model.mechanics import ACCELERATION, FORCE
from model.signals import FloatArray
from model.simulate.etd import Site, force_gains
from model.simulate.nonlinear import Model, Run, band_limited
from model.simulate.stepping import cubic_chain, drive_positions, drive_vector, exact_steps, hermite_chain, propagate

_SEGMENT = 200  # samples
_STEP = 1e-6  # relative, of finite differences of the laws


@dataclass(frozen=True, slots=True)
class Sensitivities:
    """Derivatives of the outputs, each (T, S, ...)."""

    stiffness: FloatArray  # by log k of every element, (T, S, E)
    damping: FloatArray  # by log c, (T, S, E)
    mass: FloatArray  # by log m of every degree of freedom, (T, S, n)
    laws: FloatArray  # by every parameter of every placement, in their order, (T, S, P)
    first_state: FloatArray  # (T, S, N)


@dataclass(frozen=True, slots=True)
class _Tangent:
    """Derivatives of the laws along the run on the fine grid."""

    whole: FloatArray  # of [f, z'] by [y, z], (nodes, L + M, 2L + M)
    rest: FloatArray  # by every change with y and z held, (nodes, L + M, V)


def sensitivities(run: Run) -> Sensitivities:
    """Derivatives of `run.outputs`."""
    model, m = run.model, run.model.mechanics
    E, n = len(m.stiffness), m.n
    linear, known, direct = _linear_part(run)
    tangent = _tangent(run, 2 * E + n)
    V = tangent.rest.shape[2]
    L = len(model.weights)
    padded = np.zeros((*known.shape[:2], V))
    padded[:, :, : known.shape[2]] = known
    inhomogeneous = tangent.rest + tangent.whole[:, :, : 2 * L] @ padded
    states, force = _sweep(model, tangent.whole, inhomogeneous, _memory_start(run, V))
    states[:, :, : linear.shape[2]] += linear
    shown = band_limited(force.reshape(len(force), L * states.shape[2]), model.parts).reshape(
        len(states), L, states.shape[2]
    )
    out = np.einsum("sn,tnv->tsv", model.C, states) + np.einsum("sl,tlv->tsv", model.force_outputs, shown)
    out[:, :, : direct.shape[2]] += direct
    return Sensitivities(
        out[:, :, :E], out[:, :, E : 2 * E], out[:, :, 2 * E : 2 * E + n], out[:, :, 2 * E + n : V], out[:, :, V:]
    )


def _linear_part(run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Answer of the linear system to the changes' own forces.

    States at the samples (T, N, 2E + n), motion of the sites on the fine grid (nodes, 2L, 2E + n), and what the
    sensors show at once (T, S, 2E + n).
    """
    model, m = run.model, run.model.mechanics
    n, E, dt = m.n, len(m.stiffness), model.dt
    chains, acceleration = _change_chains(run)
    columns = np.hstack([-m.H.T / m.mass[:, None], -np.eye(n)])
    columns = np.vstack([np.zeros_like(columns), columns])  # (N, E + n)
    exact = exact_steps(model.A, columns, np.zeros_like(columns), dt, model.parts)
    which = np.concatenate([np.arange(E), np.arange(E), E + np.arange(n)])
    N, K = 2 * n, E + n
    picked = exact.phi[:, :N, N + which[:, None] + K * np.arange(4)]  # (parts + 1, N, V, 4)
    push = np.einsum("nvc,tcv->tnv", picked[-1], chains, optimize=True)
    states = propagate(exact.transition, push, np.zeros((N, len(which))))
    rows = model.motion_rows
    fine = np.empty(((len(states) - 1) * model.parts + 1, len(rows), len(which)))
    for j in range(model.parts):
        inner = (rows @ exact.phi[j, :N, :N]) @ states[:-1]
        inner += np.einsum("rvc,tcv->trv", np.tensordot(rows, picked[j], 1), chains, optimize=True)
        fine[j : -1 : model.parts] = inner
    fine[-1] = rows @ states[-1]
    return states, fine, _direct(run, acceleration)


def _change_chains(run: Run) -> tuple[FloatArray, FloatArray]:
    """Forces k d, c v and accelerations q'' as cubics on every interval, (T-1, 4, 2E + n), and q'' (T, n).

    Rates and accelerations have kinks at the samples, where the inputs' second derivatives jump: slopes are one-sided.
    """
    model, m = run.model, run.model.mechanics
    n, dt = m.n, model.dt
    chain = cubic_chain(run.knots, dt)
    K = chain.shape[1] // 4
    second = (chain[:, 2 * K : 3 * K] / dt**2, (chain[:, 2 * K : 3 * K] + chain[:, 3 * K :]) / dt**2)
    values, _ = drive_positions(m)
    support = np.searchsorted(values, m.support_drive)
    u, b = drive_vector(m, run.knots), model.force_columns
    slope = run.states @ model.A.T + u @ model.B.T + run.force @ b.T  # x'
    h = dt / model.parts
    fine = run.solution.force[..., 0]
    rise = (fine[1:] - fine[:-1]) / h
    ends = (rise[:: model.parts], rise[model.parts - 1 :: model.parts])  # f' behind and before the samples
    of_rate, of_acceleration = [], []
    for side, part in enumerate((slice(None, -1), slice(1, None))):
        du = np.zeros((len(chain), m.drives))
        du[:, m.support_drive] = run.knots[part, 1::2][:, support]
        du[:, m.support_drive + 1] = second[side][:, support]
        du[:, m.force_drive] = run.knots[part, 1::2][:, np.searchsorted(values, m.force_drive)]
        of_rate.append(slope[part, n:] @ m.H.T + second[side][:, support] @ m.G.T)
        of_acceleration.append((slope[part] @ model.A.T + du @ model.B.T + ends[side] @ b.T)[:, n:])
    k, c = m.stiffness, m.damping
    d, v, a = run.deflection, run.rate, slope[:, n:]
    parts = [
        hermite_chain(k * d[:-1], k * d[1:], k * v[:-1], k * v[1:], dt=dt),
        hermite_chain(c * v[:-1], c * v[1:], c * of_rate[0], c * of_rate[1], dt=dt),
        hermite_chain(a[:-1], a[1:], of_acceleration[0], of_acceleration[1], dt=dt),
    ]
    return np.concatenate([part.reshape(len(chain), 4, -1) for part in parts], axis=2), a


def _direct(run: Run, acceleration: FloatArray) -> FloatArray:
    """What accelerometers and force sensors show of the changes at once, (T, S, 2E + n)."""
    m = run.model.mechanics
    kind = m.sensor_kind[:, None]
    pull = np.where(kind == ACCELERATION, -(m.S / m.mass) @ m.H.T, 0) + np.where(kind == FORCE, m.L, 0)
    forces = (m.stiffness * run.deflection, m.damping * run.rate)
    of_mass = np.where(kind == ACCELERATION, -m.S, 0) * acceleration[:, None, :]
    return np.concatenate([*(pull * force[:, None, :] for force in forces), of_mass], axis=2)


def _tangent(run: Run, plain: int) -> _Tangent:
    """Derivatives of all laws by finite differences on the fine grid; `plain` changes come before the laws' own."""
    model, E = run.model, len(run.model.mechanics.stiffness)
    sites, nodes = model.sites(), len(run.solution.force)
    L, M = len(sites), sum(site.law.memory for site in sites)
    V = plain + sum(len(placement.p) for placement in model.placements)
    whole, rest = np.zeros((nodes, L + M, 2 * L + M)), np.zeros((nodes, L + M, V))
    owners = [number for number, placement in enumerate(model.placements) for _ in placement.weights(E)]
    columns = plain + np.cumsum([0, *(len(placement.p) for placement in model.placements)])
    at = 0
    for i, (site, owner) in enumerate(zip(sites, owners, strict=True)):
        own = [i, *range(L + at, L + at + site.law.memory)]  # its force and its memory's rates
        answer = _Answer(run, i, site)
        whole[:, own, i], whole[:, own, L + i] = answer.by_motion("deflection"), answer.by_motion("rate")
        for j in range(site.law.memory):
            whole[:, own, 2 * L + at + j] = answer.by_memory(j)
        for j in range(len(site.p)):
            rest[:, own, columns[owner] + j] += answer.by_parameter(j)
        share = np.abs(model.weights[i]) / np.abs(model.weights[i]).sum()  # a pair's element is its mean
        for first, field in ((0, "stiffness"), (E, "damping")):
            rest[:, own, first : first + E] += answer.by_element(field)[:, :, None] * share
        at += site.law.memory
    return _Tangent(whole, rest)


class _Answer:
    """Force and memory rates of one site along the run, (nodes, 1 + memory), and their derivatives."""

    def __init__(self, run: Run, i: int, site: Site) -> None:
        L, solution = len(run.model.weights), run.solution
        self.site, self.nodes = site, len(solution.force)
        time = run.start + np.arange(self.nodes) * (run.model.dt / run.model.parts)
        d, v = solution.motion[:, i, 0], solution.motion[:, L + i, 0]
        self.motion = Motion(d, v, time, solution.memories[i][:, :, 0].T)

    def __call__(self, motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        law = self.site.law
        force = np.broadcast_to(law.force(motion, p, element), (1, self.nodes))
        return np.concatenate([force, law.memory_rate(motion, p, element)]).T if law.memory else force.T

    def by_motion(self, field: str) -> FloatArray:
        value = getattr(self.motion, field)
        step = _STEP * max(float(np.abs(value).max()), 1e-12)
        up, down = (self._at(self.motion._replace(**{field: value + s * step})) for s in (1, -1))
        return (up - down) / (2 * step)

    def by_memory(self, j: int) -> FloatArray:
        z = self.motion.memory
        shift = np.zeros((len(z), 1))
        shift[j] = _STEP * max(float(np.abs(z[j]).max()), 1e-12)
        up, down = (self._at(self.motion._replace(memory=z + s * shift)) for s in (1, -1))
        return (up - down) / (2 * shift[j, 0])

    def by_parameter(self, j: int) -> FloatArray:
        p = self.site.p
        step = _STEP * (abs(p[j]) or 1.0)
        moved = [tuple(x + s * step * (q == j) for q, x in enumerate(p)) for s in (1, -1)]
        up, down = (self(self.motion, values, self.site.element) for values in moved)
        return (up - down) / (2 * step)

    def by_element(self, field: str) -> FloatArray:
        """By the logarithm of the element's stiffness or damping."""
        value = getattr(self.site.element, field)
        moved = [self.site.element._replace(**{field: value * (1 + s * _STEP)}) for s in (1, -1)]
        up, down = (self(self.motion, self.site.p, element) for element in moved)
        return (up - down) / (2 * _STEP)

    def _at(self, motion: Motion) -> FloatArray:
        return self(motion, self.site.p, self.site.element)


def _memory_start(run: Run, V: int) -> FloatArray:
    """Derivatives of the memories at the first sample by all changes and by the first state, (M, V + N)."""
    model, m = run.model, run.model.mechanics
    L, E, N = len(model.weights), len(m.stiffness), model.A.shape[0]
    rows = []
    for i, site in enumerate(model.sites()):
        d, v = run.solution.motion[0, [i, L + i], 0]

        def begin(d: float, v: float, element: SpringDamper, site=site) -> FloatArray:  # type: ignore[no-untyped-def]
            z = site.law.memory_start(Motion(d, v, run.start), site.p, element)
            return np.broadcast_to(np.ravel(z), (site.law.memory,))

        def slope(move: tuple[float, float, float, float], d=d, v=v, site=site, begin=begin) -> FloatArray:  # type: ignore[no-untyped-def]
            up, down = (
                begin(
                    d + s * move[0],
                    v + s * move[1],
                    SpringDamper(*(x * (1 + s * r) for x, r in zip(site.element, move[2:], strict=True))),
                )
                for s in (_STEP, -_STEP)
            )
            return (up - down) / (2 * _STEP)

        row = np.zeros((site.law.memory, V + N))
        row[:, V:] = np.outer(slope((1, 0, 0, 0)), model.motion_rows[i])
        row[:, V:] += np.outer(slope((0, 1, 0, 0)), model.motion_rows[L + i])
        share = np.abs(model.weights[i]) / np.abs(model.weights[i]).sum()
        row[:, :E] = np.outer(slope((0, 0, 1, 0)), share)
        row[:, E : 2 * E] = np.outer(slope((0, 0, 0, 1)), share)
        rows.append(row)
    return np.concatenate([np.zeros((0, V + N)), *rows])


def _sweep(
    model: Model, whole: FloatArray, rest: FloatArray, memory_start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States at the samples (T, N, V + N) and forces on the fine grid (nodes, L, V + N) of all changes.

    The last N changes are those of the first state; for them the states are whole, for the others the laws' part.
    """
    nodes, wide, V = rest.shape
    N, L = model.A.shape[0], len(model.weights)
    M, parts = wide - L, model.parts
    B = N + M  # a basis of first states and memories
    samples = (nodes - 1) // parts
    segments = -(-samples // _SEGMENT)
    Q = -(-samples // segments)
    h = model.dt / parts
    E, early, late = force_gains(model.A, model.force_columns, h)
    R = model.motion_rows
    closed, constant = _closed(whole, rest, R @ late, h, L)
    ahead = np.zeros((N + 2 * L + M, N + L + 2 * M))  # from [x, f, z', z] to what they alone lead to: x, y, z
    ahead[:N, :N], ahead[:N, N : N + L] = E, early
    ahead[N : N + 2 * L] = R @ ahead[:N]
    ahead[N + 2 * L :, N + L : N + L + M] = h / 2 * np.eye(M)
    ahead[N + 2 * L :, N + L + M :] = np.eye(M)
    at = np.minimum(np.arange(segments)[:, None] * Q * parts + np.arange(Q * parts + 1), nodes - 1)
    X = np.zeros((N + L + 2 * M, segments, V + B))
    X[:N, :, V : V + N] = np.eye(N)[:, None]
    X[N + L + M :, :, V + N :] = np.eye(M)[:, None]
    first = np.zeros((2 * L + M, segments, V + B))
    first[: 2 * L] = np.tensordot(R, X[:N], 1)
    first[2 * L :] = X[N + L + M :]
    X[N : N + L + M] = np.einsum("sij,jsv->isv", whole[at[:, 0]], first)
    X[N : N + L + M, :, :V] += rest[at[:, 0]].transpose(1, 0, 2)
    states = np.empty((Q + 1, N, segments, V + B))
    forces = np.empty((Q * parts + 1, L, segments, V + B))
    states[0], forces[0] = X[:N], X[N : N + L]
    for i in range(1, Q * parts + 1):
        led = (ahead @ X.reshape(len(X), -1)).reshape(-1, segments, V + B)
        own = np.einsum("sij,jsv->isv", closed[at[:, i]], led[N:])
        own[:, :, :V] += constant[at[:, i]].transpose(1, 0, 2)
        X[:N] = led[:N] + np.tensordot(late, own[:L], 1)
        X[N : N + L + M] = own
        X[N + L + M :] = led[N + 2 * L :] + h / 2 * own[L:]
        forces[i] = own[:L]
        if i % parts == 0:
            states[i // parts] = X[:N]
    ends = np.concatenate([X[:N], X[N + L + M :]])
    begin = np.zeros((B, V + N))
    begin[:N, V:], begin[N:] = np.eye(N), memory_start
    return _superpose(states, forces, ends, begin, (samples, parts))


def _closed(whole: FloatArray, rest: FloatArray, gain: FloatArray, h: float, L: int) -> tuple[FloatArray, FloatArray]:
    """Forces and memory rates at the end of a step, their own effect within the step solved for."""
    M = whole.shape[1] - L
    back = np.zeros((2 * L + M, L + M))
    back[: 2 * L, :L] = gain
    back[2 * L :, L:] = h / 2 * np.eye(M)
    inverse = np.linalg.inv(np.eye(L + M) - whole @ back)
    return inverse @ whole, inverse @ rest


def _superpose(
    states: FloatArray, forces: FloatArray, ends: FloatArray, begin: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Join the segments: each begins where the one before it ended."""
    samples, parts = size
    segments = states.shape[2]
    V = states.shape[3] - len(ends)
    whole_states: list[FloatArray] = []
    whole_forces: list[FloatArray] = []
    for s in range(segments):
        for path, store in ((states, whole_states), (forces, whole_forces)):
            joined = path[:, :, s, V:] @ begin
            joined[:, :, :V] += path[:, :, s, :V]
            store.append(joined[:-1] if s < segments - 1 else joined)
        following = ends[:, s, V:] @ begin
        following[:, :V] += ends[:, s, :V]
        begin = following
    return (
        np.concatenate(whole_states)[: samples + 1],
        np.concatenate(whole_forces)[: samples * parts + 1],
    )
