"""Score tests of all laws, places and shapes on the residual of a fit.

The whitened response of the sensors to a candidate's force along the fitted motion is a column c, in units of noise
like the residual r and the Jacobian J of the fit.  After projection onto the complement of J, c' = c - Q Q^T c, the
statistic (c'^T r)^2 / |c'|^2 is chi-square with one degree of freedom if the candidate is absent (Rao's score test),
whatever the parameters have absorbed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtrc

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import RULES, ScreeningRules
from sprung.model.diagnosis.screening.families import ELEMENT, Family
from sprung.model.signals import FloatArray

MEDIAN_OF_CHI_SQUARE = 1.386  # with two degrees of freedom
_ROUNDING = 1e-7  # share of a squared column that the projection leaves of one that the Jacobian contains


@dataclass(frozen=True)
class Candidate:
    """A law at a place, as screened."""

    term: Term  # with the amplitude of the screening
    score: float  # chi-square
    family: Family
    beyond: float = 1.0  # estimated strength over the law's largest admissible one, at least 1
    start: Point | None = None  # initial values of its fit, if not those of the screened model

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the score."""
        return len(self.term.parameters) if self.family.freedom is None else self.family.freedom

    @property
    def p_single(self) -> float:
        """p-value of the score as a single test."""
        return float(chdtrc(self.freedom, self.score))

    def strength(self, rules: ScreeningRules = RULES.screening) -> float:
        """Score less its level under noise alone: comparable between families."""
        return self.score - rules.per_freedom * (self.freedom - 1) - self.family.look_elsewhere(rules)

    @property
    def location(self) -> str:
        return self.term.location

    @property
    def effect(self) -> str:
        return self.term.law.name


@dataclass(frozen=True)
class Screening:
    """All candidates, best first, with p-values corrected for multiple testing."""

    candidates: tuple[Candidate, ...]  # the best shape of every law at every place
    tests: dict[Family, int]  # number of tests
    of_laws: float = RULES.screening.of_laws  # share of the chance of a false finding, for laws at elements

    def tried(self, family: Family) -> int:
        """Bonferroni's number: tests of the family, over its share of the chance of a false finding."""
        others = len(self.tests) - 1
        if others < 1 or ELEMENT not in self.tests:
            return self.tests[family] * len(self.tests)
        share = self.of_laws if family is ELEMENT else (1 - self.of_laws) / others
        return round(self.tests[family] / share)

    def p_value(self, candidate: Candidate) -> float:
        """p-value, corrected for multiple testing."""
        return float(min(1.0, candidate.p_single * self.tried(candidate.family)))

    def localization(self) -> dict[str, float]:
        best: dict[str, float] = {}
        for one in self.candidates:
            best[one.location] = max(best.get(one.location, 0.0), one.score)
        return dict(sorted(best.items(), key=lambda item: -item[1]))


class Projector:
    """Residual and columns of candidates, projected onto the complement of the fit's Jacobian."""

    def __init__(self, problem: Problem, fit: Fit, project: bool = True) -> None:
        jacobian = fit.jacobian if project else fit.jacobian[:, -len(fit.point.state) :]
        scale = np.linalg.norm(jacobian, axis=0)
        self.kept = scale > 1e-9 * max(scale.max(initial=0.0), 1e-300)
        q, r = np.linalg.qr(jacobian[:, self.kept] / scale[self.kept])
        strong = np.abs(np.diag(r)) > 1e-9
        self.q, self.r, self.scale = q[:, strong], r, scale
        self.strong = strong
        self.residual = fit.residual - self.q @ (self.q.T @ fit.residual)
        self.problem, self.fit = problem, fit
        grid = problem.part.grid
        self.grid = grid
        factor = fit.whitener.factor
        shown = fit.forward.sensor_factor[grid.band, :, None]
        plant = fit.forward.plant
        self.of_force = factor @ (plant.sensor_of_force[grid.band] * shown)  # whitened, (F, S, E)
        self.of_support = factor @ (plant.sensor_of_support[grid.band] * shown)  # (F, S, supports)
        self.of_load = factor @ (plant.sensor_of_load[grid.band] * shown)  # (F, S, n)
        self.factor = factor

    @cached_property
    def score_offset(self) -> FloatArray:
        """Component of the residual in the span of J, if its covariance depends on the parameters.

        The optimum of such a fit is J^T r = d log det R / 2, not zero.
        """
        slope = np.concatenate([self.fit.log_det_slope, np.zeros(len(self.fit.point.state))])[-len(self.kept) :]
        score_offset = np.linalg.lstsq(self.r.T, slope[self.kept] / self.scale[self.kept], rcond=1e-9)[0]
        return np.asarray(self.q @ score_offset[self.strong] / 2)

    def spread(self, column: FloatArray, change: ComplexArray) -> float:
        """Correction to the product of a column and the residual from the derivative of the log determinant.

        change: derivative (F, S, inputs) of the response to the inputs.  Not needed for forces along elements, for
        which the determinant acts as on the spring and damper that they resemble.
        """
        if not self.problem.process_noise:
            return 0.0
        return float(column @ self.score_offset) - self.fit.whitener.log_det_slope(change) / 2

    @cached_property
    def complex_q(self) -> ComplexArray:
        """The projection's basis as band spectra, (F, S, q)."""
        return self.unpack(self.q)

    @cached_property
    def complex_residual(self) -> ComplexArray:
        return self.unpack(self.residual)

    def unpack(self, packed: FloatArray) -> ComplexArray:
        """Real vectors (2 F S, ...) as weighted band spectra (F, S, ...)."""
        half = len(packed) // 2
        shape = (self.grid.band.stop, -1, *packed.shape[1:])
        return (packed[:half] + 1j * packed[half:]).reshape(shape)

    def pack(self, whitened: ComplexArray) -> FloatArray:
        """Already whitened band spectra (F, S) as a real vector."""
        weighted = whitened * self.grid.weight[:, None]
        return np.concatenate([weighted.real.ravel(), weighted.imag.ravel()])

    def of_port(self, port: FloatArray) -> ComplexArray:
        """Whitened response (F, S) of the sensors to a force along a port (E,): one element, or those of a pair."""
        response: ComplexArray = self.of_force[:, :, : len(port)] @ port
        return response

    def seen_of(self, port: FloatArray, force: ComplexArray) -> FloatArray:
        """Reduction of the residual by a force (F,) along a port, (2 F S,)."""
        return self.pack(self.of_port(port) * force[:, None])

    def score(
        self, column: FloatArray, more: tuple[float, float] = (0.0, 0.0), least: float = _ROUNDING
    ) -> tuple[float, float]:
        """Statistic and amplitude of a column.

        more: the same of residuals outside the sensors (product, square); least: share of the column's square that
        the projection has to leave, as much as an error of the columns would leave of one that they can imitate.
        """
        inside = self.q.T @ column
        size = float(column @ column)
        left = size - float(inside @ inside)
        if left <= least * size and more[1] <= 0:
            return 0.0, 0.0
        left = max(left, least * size) + more[1]
        product = float(column @ self.residual) + more[0]
        return product**2 / left, product / left

    def nonnegative(self, columns: FloatArray) -> tuple[float, FloatArray]:
        """Statistic and amplitudes (m,) of several columns (R, m) together, no amplitude negative."""
        inside = self.q.T @ columns
        size = np.sum(columns**2, axis=0)
        left = columns.T @ columns - inside.T @ inside
        amounts = np.zeros(columns.shape[1])
        seen = np.flatnonzero(np.diag(left) > _ROUNDING * size)
        scale = 1 / np.sqrt(np.diag(left)[seen])
        values, vectors = np.linalg.eigh(left[np.ix_(seen, seen)] * np.outer(scale, scale))
        root = np.sqrt(np.maximum(values, 1e-9))
        product = scale * (columns[:, seen].T @ self.residual)
        if len(seen):
            amounts[seen] = scale * nnls((vectors * root).T, vectors.T @ product / root)[0]
        return float(amounts[seen] @ (product / scale)), amounts


class ScalarResponse:
    """Scores of columns of the form response (F, S) times scalar spectrum h (F,), for all trials at once."""

    def __init__(self, product: ComplexArray, size: FloatArray, inside: ComplexArray) -> None:
        """Of the conjugate response's product with the residual (F,) and with the projection's basis (F, q).

        size: the response's square, (F,).
        """
        self.product, self.size = product, size
        # as real rows (2 F,), which halves the work of the real part of complex products
        self._product = np.concatenate([product.real, product.imag])
        self._size = np.concatenate([size, size])
        self._inside = np.concatenate([inside.real, inside.imag])

    @classmethod
    def of(cls, projector: Projector, response: ComplexArray) -> ScalarResponse:
        """Of a whitened response (F, S)."""
        weighted = (response * projector.grid.weight[:, None]).conj()
        product = np.einsum("fs,fs->f", weighted, projector.complex_residual)
        inside = np.einsum("fs,fsq->fq", weighted, projector.complex_q, optimize=True)
        return cls(product, np.sum(np.abs(weighted) ** 2, axis=1), inside)

    def scores(self, h: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Statistics and amplitudes of trials h (trials, F)."""
        rows = np.concatenate([h.real, h.imag], axis=1)
        product, inside = rows @ self._product, rows @ self._inside
        size = rows**2 @ self._size
        left = size - np.sum(inside**2, axis=1)
        visible = left > 1e-7 * size
        left = np.where(visible, left, 1.0)
        return np.where(visible, product**2 / left, 0.0), np.where(visible, product / left, 0.0)

    def products(self, h: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of columns h (m, F) with the residual (m,), with each other (m, m), both projected, and squares (m,)."""
        rows = np.concatenate([h.real, h.imag], axis=1)
        product, inside = rows @ self._product, rows @ self._inside
        whole = (rows * self._size) @ rows.T
        return product, whole - inside @ inside.T, np.diag(whole)

    def joint(self, h: ComplexArray) -> tuple[float, FloatArray]:
        """Statistic and amplitudes of several columns h (m, F) together."""
        product, gram, _ = self.products(h)
        scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram * scale * scale[:, None])
        good = values > 1e-6
        turned = vectors[:, good].T @ (product * scale)
        return float(np.sum(turned**2 / values[good])), scale * (vectors[:, good] @ (turned / values[good]))
