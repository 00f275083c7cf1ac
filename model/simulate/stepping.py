"""Exact steps of x' = A x + b value + b' rate for drives that are cubics between samples, on a fine grid.

In units of the sample interval the cubic of a drive and its derivatives c0 = value, c1, c2, c3 form a chain
c_i' = c_{i+1}.  State and chains together are autonomous, so that one matrix exponential gives the exact state at
every fraction of a sample (Van Loan 1978), and with it every linear output there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sprung.model.mechanics import Mechanics
from sprung.model.signals import FloatArray


def cubic_chain(knots: FloatArray, dt: float) -> FloatArray:
    """Chains [c0 of every drive, c1.., c2.., c3..] at the start of every interval, (..., T-1, 4K).

    knots (..., T, 2K) hold value and slope of each drive at the samples.
    """
    value, slope = knots[..., 0::2], knots[..., 1::2]
    return hermite_chain(value[..., :-1, :], value[..., 1:, :], slope[..., :-1, :], slope[..., 1:, :], dt=dt)


def hermite_chain(
    first: FloatArray, last: FloatArray, first_slope: FloatArray, last_slope: FloatArray, *, dt: float
) -> FloatArray:
    """The same from both ends of every interval, each (..., intervals, K); slopes may jump from one to the next."""
    rise, begin, end = last - first, dt * first_slope, dt * last_slope
    return np.concatenate([first, begin, 6 * rise - 4 * begin - 2 * end, 6 * (begin + end) - 12 * rise], axis=-1)


@dataclass(frozen=True, slots=True)
class ExactSteps:
    """Propagators of [state, chains] over j = 0 .. parts fractions of a sample."""

    size: int  # N
    dt: float  # s
    phi: FloatArray  # shape (parts + 1, N + 4K, N + 4K)

    @property
    def transition(self) -> FloatArray:
        """Of the state over one sample, (N, N)."""
        return self.phi[-1, : self.size, : self.size]

    def path(self, chain: FloatArray, x0: FloatArray) -> FloatArray:
        """States at the samples, (T, N, V), for chains (T-1, 4K, V) and first states (N, V)."""
        push = self.phi[-1, : self.size, self.size :] @ chain
        return propagate(self.transition, push, x0)

    def fine(self, rows: FloatArray, states: FloatArray, chain: FloatArray) -> FloatArray:
        """Outputs rows (R, N + 4K) @ [state, chains] on the fine grid: ((T-1) parts + 1, R, V).

        states (T, N, V) at the samples, chain (T-1, 4K, V).
        """
        parts = len(self.phi) - 1
        table = (rows @ self.phi[:-1]).reshape(-1, rows.shape[1])  # (parts * R, N + 4K)
        inner = table @ np.concatenate([states[:-1], chain], axis=1)  # (T-1, parts * R, V)
        T, _, V = states.shape
        last = (rows @ self.phi[-1]) @ np.concatenate([states[-2], chain[-1]], axis=0)
        return np.concatenate([inner.reshape((T - 1) * parts, len(rows), V), last[None]], axis=0)


def propagate(transition: FloatArray, push: FloatArray, x0: FloatArray) -> FloatArray:
    """x_{k+1} = transition x_k + push_k; push (T-1, N, V) -> (T, N, V)."""
    path = np.empty((len(push) + 1, *x0.shape))
    path[0] = x0
    for k in range(len(push)):
        np.matmul(transition, path[k], out=path[k + 1])
        path[k + 1] += push[k]
    return path


def exact_steps(A: FloatArray, value: FloatArray, rate: FloatArray, dt: float, parts: int) -> ExactSteps:
    """Propagators for A (N, N) and input columns of the drives' values and rates, each (N, K)."""
    N, K = value.shape
    whole = np.zeros((N + 4 * K, N + 4 * K))
    whole[:N, :N] = dt * A
    whole[:N, N : N + K] = dt * value
    whole[:N, N + K : N + 2 * K] = rate
    for i in range(3):
        at = N + i * K
        whole[at : at + K, at + K : at + 2 * K] = np.eye(K)
    one = scipy.linalg.expm(whole / parts)
    phi = np.empty((parts + 1, *whole.shape))
    phi[0] = np.eye(len(whole))
    for j in range(parts):
        phi[j + 1] = phi[j] @ one
    return ExactSteps(N, dt, phi)


def drive_columns(mechanics: Mechanics, B: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Input columns of the values and of the rates of all drives in the order of u, each (N, K)."""
    values, rates = drive_positions(mechanics)
    rate = np.zeros((len(B), len(values)))
    for i, at in enumerate(rates):
        if at is not None:
            rate[:, i] = B[:, at]
    return B[:, values], rate


def drive_positions(mechanics: Mechanics) -> tuple[list[int], list[int | None]]:
    """Where u holds the value and the rate (None: a force has none) of each drive, in the order of u."""
    found = [(int(at), int(at) + 1) for at in mechanics.support_drive]
    plain = [(int(at), None) for at in mechanics.force_drive]
    ordered = sorted([*found, *plain], key=lambda pair: pair[0])
    return [value for value, _ in ordered], [rate for _, rate in ordered]


def drive_vector(mechanics: Mechanics, knots: FloatArray) -> FloatArray:
    """u (T, drives) at the samples from knots (T, 2K)."""
    u = np.empty((len(knots), mechanics.drives))
    for i, (value, rate) in enumerate(zip(*drive_positions(mechanics), strict=True)):
        u[:, value] = knots[:, 2 * i]
        if rate is not None:
            u[:, rate] = knots[:, 2 * i + 1]
    return u
