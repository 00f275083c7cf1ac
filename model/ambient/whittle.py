"""Whittle likelihood of a window's spectral matrices, with its gradient and Fisher information.

    2 L(x) = 2 sum_g m_g (log det S_g(x) + tr S_g(x)^-1 Y_g),      S = R + A X A^H

with Y_g the averaged periodogram of group g and m_g its degrees of freedom, R the noise of the signals (1), A their
response to the sources and X the sources' spectral matrix.  With W_i = S^-1/2 dS/dx_i S^-H/2,

    dL/dx_i = sum_g m_g tr W_i (1 - S^-1/2 Y S^-H/2),      F_ij = sum_g m_g tr W_i W_j
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.excitation import Excitation
from sprung.model.ambient.periodogram import Spectra
from sprung.model.ambient.response import Responses
from sprung.model.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The negative log-likelihood at a point of x = [P log-ratios, Q free numbers of the excitation]."""

    cost: float
    gradient: FloatArray  # shape (P + Q,)
    information: FloatArray  # Fisher's, shape (P + Q, P + Q)
    whitened: np.ndarray  # S^-1/2 Y S^-H/2, one on average where the model holds, shape (F, S, S)
    covariance: np.ndarray  # S, shape (F, S, S)
    noise: FloatArray  # of the sensors, part of S, shape (F, S, S)


class Whittle:
    """The likelihood of one window under one excitation."""

    def __init__(self, responses: Responses, excitation: Excitation, spectra: Spectra, blur: float = 0.0) -> None:
        """blur: share of the signals' measured power that counts as noise beside the sensors' own.

        Signals that no source moves independently tie the parameters so closely that far from the solution the
        likelihood is a narrow crooked valley; a blur widens it for the first steps.
        """
        self.responses, self.excitation, self.spectra = responses, excitation, spectra
        self.seen = responses.sensing.seen(spectra.matrix)
        power = np.diagonal(self.seen, axis1=1, axis2=2).real
        self.noise = (1 + blur * power)[:, :, None] * np.eye(power.shape[1])
        self.P = len(responses.unknowns)
        self.omega = spectra.sides

    def cost(self, x: FloatArray) -> float:
        """The negative log-likelihood alone."""
        response = self.responses.at(x[: self.P], self.omega)
        sources = self.excitation.sources(x[self.P :])
        S = self.noise + _centre(response.signals @ sources.matrix @ adjoint(response.signals))
        _, log_det, whitened = self._whiten(S)
        return self._cost(log_det, whitened)

    def evaluate(self, x: FloatArray) -> Evaluation:
        """Everything that a step of Fisher scoring needs."""
        response = self.responses.at(x[: self.P], self.omega)
        sources = self.excitation.sources(x[self.P :])
        A = response.signals
        XA = sources.matrix @ adjoint(A)
        S = self.noise + _centre(A @ XA)
        inverse, log_det, whitened = self._whiten(S)
        F, size, both = len(S), S.shape[1] ** 2, np.concatenate([inverse, inverse])
        column, row = both @ response.per_force, response.motion @ XA @ adjoint(both)
        place = (column.swapaxes(1, 2)[:, :, :, None] * row[:, :, None, :]).reshape(2 * F, -1, size)
        by_unknown = (response.factor @ place).reshape(2 * F, -1, *S.shape[1:])
        by_unknown = by_unknown + adjoint(by_unknown)
        white = (both @ A)[:, None]
        by_source = white @ sources.slopes @ adjoint(white)
        W = _centre(np.concatenate([by_unknown, by_source], axis=1)).reshape(F, -1, size)
        local = W.view(np.float64)  # (F, P + L, 2 R^2): real products are traces
        left = np.eye(S.shape[1]) - whitened
        slope = local @ np.ascontiguousarray(left.reshape(F, size, 1)).view(np.float64).reshape(F, -1, 1)
        weight = self.spectra.weight[:, None, None]
        gradient, information = self._together(slope * weight, local @ local.swapaxes(1, 2) * weight)
        return Evaluation(self._cost(log_det, whitened), gradient, information, whitened, S, self.noise)

    def _together(self, slope: FloatArray, products: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and information of all x from those of the local quantities, (F, P + L, 1) and (F, P + L, P + L)."""
        P, spread = self.P, self.excitation.spread
        Q = spread.shape[2]
        information = np.empty((P + Q, P + Q))
        information[:P, :P] = products[:, :P, :P].sum(axis=0)
        information[:P, P:] = np.einsum("fpl,flq->pq", products[:, :P, P:], spread, optimize=True)
        information[P:, :P] = information[:P, P:].T
        information[P:, P:] = np.tensordot(spread, products[:, P:, P:] @ spread, axes=([0, 1], [0, 1]))
        gradient = np.concatenate([slope[:, :P, 0].sum(axis=0), np.einsum("fl,flq->q", slope[:, P:, 0], spread)])
        return gradient, information

    def _whiten(self, S: np.ndarray) -> tuple[np.ndarray, FloatArray, np.ndarray]:
        """S^-1/2 (lower triangular), log det S and the whitened periodograms."""
        factor = np.linalg.cholesky(S)
        inverse = np.linalg.inv(factor)
        log_det = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2).real).sum(axis=1)
        return inverse, log_det, inverse @ self.seen @ adjoint(inverse)

    def _cost(self, log_det: FloatArray, whitened: np.ndarray) -> float:
        trace = np.einsum("fii->f", whitened).real
        return float(self.spectra.weight @ (log_det + trace))


def adjoint(matrix: np.ndarray) -> np.ndarray:
    """Conjugate transpose of matrices (..., n, m), (..., m, n)."""
    return np.asarray(matrix.conj().swapaxes(-1, -2))


def _centre(sides: np.ndarray) -> np.ndarray:
    """Means over the two frequencies of each group."""
    return np.asarray(sides.reshape(2, -1, *sides.shape[1:]).mean(axis=0))
