"""The restoring force of an element, estimated without a law: a smooth surface over deflection and rate.

    f(d, v) = sum_ij c_ij B_i(d) B_j(v)         cubic B-splines, on top of k d + c v

The sensors answer linearly to the force, so with Phi the whitened answers to the basis forces along the motion,

    r = J a + Phi c + e,   e ~ N(0, s^2 I),   c ~ N(0, P^-1),   P = l_d Pd + l_v Pv + l_0 I

where J (everything that is fitted anyway) is projected out, Pd and Pv are squared second differences along the two
axes (P-splines, Eilers and Marx 1996) and l_d, l_v, l_0 maximise the evidence.  The surface is kept orthogonal to 1, d
and v along the motion: what a static load, the spring and the damper explain belongs to them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from sprung.model.laws.base import ElementLaw, ParameterSpec, Values
from sprung.model.laws.motion import Motion, SpringDamper
from sprung.model.signals import FloatArray

_INTERVALS = (10, 8)  # of the splines over deflection and rate
# Least weights of roughness and size over 1 / force^2: a surface that bends by more than thrice the force's rms from
# one knot to the next is the model's error elsewhere, not a force
_LEAST = (0.1, 0.1, 1e-3)
_MARGIN = 1.02  # range of the surface over the largest motion seen


@dataclass(frozen=True)
class Axis:
    """Uniform cubic B-splines from -reach to reach; beyond, the surface stays as at its edge."""

    reach: float
    intervals: int

    @property
    def count(self) -> int:
        return self.intervals + 3

    def basis(self, x: FloatArray) -> FloatArray:
        """Values of all splines, (..., count)."""
        x = np.asarray(x, dtype=float)
        u = np.clip((x / self.reach + 1) * (self.intervals / 2), 0, self.intervals * (1 - 1e-12))
        i = u.astype(np.int64)
        t = u - i
        weights = (
            (1 - t) ** 3 / 6,
            (3 * t**3 - 6 * t**2 + 4) / 6,
            (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
            t**3 / 6,
        )
        out = np.zeros((x.size, self.count))
        rows, first = np.arange(x.size), i.ravel()
        for offset, weight in enumerate(weights):
            out[rows, first + offset] = weight.ravel()
        return out.reshape(*x.shape, self.count)

    @cached_property
    def roughness(self) -> FloatArray:
        """Sum of squared second differences of the coefficients, as a matrix (count, count)."""
        second = np.diff(np.eye(self.count), 2, axis=0)
        return second.T @ second


@dataclass(frozen=True)
class Surface:
    """The splines over both axes, and the motion that they belong to."""

    deflection: Axis
    rate: Axis
    motion: tuple[FloatArray, FloatArray]  # deflection and rate that were seen, each (T,)

    @classmethod
    def over(cls, d: FloatArray, v: FloatArray) -> Surface:
        """A surface for a motion; both (T,)."""
        reach = [max(_MARGIN * float(np.abs(x).max(initial=0.0)), 1e-12) for x in (d, v)]
        return cls(Axis(reach[0], _INTERVALS[0]), Axis(reach[1], _INTERVALS[1]), (d, v))

    @property
    def count(self) -> int:
        return self.deflection.count * self.rate.count

    def forces(self, d: FloatArray, v: FloatArray) -> FloatArray:
        """Every basis force along a motion, (T, count)."""
        both = self.deflection.basis(d)[:, :, None] * self.rate.basis(v)[:, None, :]
        return both.reshape(len(d), self.count)

    def value(self, coefficients: FloatArray, d: FloatArray, v: FloatArray) -> FloatArray:
        """The surface at points of any shape."""
        table = coefficients.reshape(self.deflection.count, self.rate.count)
        found: FloatArray = np.sum((self.deflection.basis(d) @ table) * self.rate.basis(v), axis=-1)
        return found

    @cached_property
    def free(self) -> FloatArray:
        """Basis of the coefficients whose force is orthogonal to 1, d and v along the motion, (count, count - 3)."""
        d, v = self.motion
        step = max(1, len(d) // 20_000)
        rows = np.stack([np.ones(len(d[::step])), d[::step] / self.deflection.reach, v[::step] / self.rate.reach])
        found: FloatArray = scipy.linalg.null_space(rows @ self.forces(d[::step], v[::step]), rcond=1e-12)
        return found

    @cached_property
    def roughness(self) -> tuple[FloatArray, FloatArray]:
        """Penalties along deflection and rate on the free coefficients."""
        along_d = np.kron(self.deflection.roughness, np.eye(self.rate.count))
        along_v = np.kron(np.eye(self.deflection.count), self.rate.roughness)
        return self.free.T @ along_d @ self.free, self.free.T @ along_v @ self.free


@dataclass(frozen=True)
class ForceMap:
    """A force over a grid of deflections and rates, ready to be drawn."""

    deflection: FloatArray  # m, (a,)
    rate: FloatArray  # m/s, (b,)
    force: FloatArray  # N, (b, a)
    std: FloatArray  # N, (b, a)


@dataclass(frozen=True)
class LatentForce:
    """An estimated surface with its uncertainty."""

    surface: Surface
    coefficients: FloatArray  # (count,)
    covariance: FloatArray  # (count, count)
    log_evidence: float  # against no force at all; above 0: the force is worth its freedom
    noise: float  # s, 1 when the whitening was right

    def force(self, d: FloatArray, v: FloatArray) -> FloatArray:
        """N, at points of any shape."""
        return self.surface.value(self.coefficients, np.asarray(d), np.asarray(v))

    def std(self, d: FloatArray, v: FloatArray) -> FloatArray:
        """Standard deviation of the force, N, at points of any shape."""
        basis = self.surface.forces(np.ravel(d), np.ravel(v))
        variance = np.einsum("tk,kl,tl->t", basis, self.covariance, basis, optimize=True)
        found: FloatArray = np.sqrt(np.maximum(variance, 0)).reshape(np.shape(d))
        return found

    def law(self, name: str = "unknown") -> SurfaceLaw:
        """The surface as a law of one parameter, its share: 1 is the surface as estimated."""

        def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
            found: FloatArray = p[0] * self.force(np.asarray(motion.deflection), np.asarray(motion.rate))
            return found

        return SurfaceLaw(
            latent=self,
            name=name,
            title="a force that no law of the catalogue explains",
            parameters=(ParameterSpec("share", "1", -5.0, 5.0, "of the estimated surface", lambda seen: 1.0),),
            force=force,
            shapes=lambda seen: np.ones((1, 1)),
            absent=(0.0,),
            looks_like="a residual that is a function of the element's deflection and rate, of no named kind",
            confused_with=(),
            sentence="a force that no law of the catalogue explains; its map is reported",
            named=False,
            listed=False,
        )

    def map(self, points: tuple[int, int] = (61, 41)) -> ForceMap:
        """The surface on a grid over the range of the motion."""
        x, y = self._grid(points)
        d, v = np.meshgrid(x, y)
        return ForceMap(x, y, self.force(d, v), self.std(d, v))

    def _grid(self, points: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        reach = (self.surface.deflection.reach, self.surface.rate.reach)
        x, y = (np.linspace(-r, r, count) / _MARGIN for r, count in zip(reach, points, strict=True))
        return x, y


@dataclass(frozen=True)
class SurfaceLaw(ElementLaw):
    """An estimated surface in the place of a law."""

    latent: LatentForce | None = None


def estimate_force(
    surface: Surface,
    motion: tuple[FloatArray, FloatArray],
    respond: Callable[[FloatArray], FloatArray],
    residual: FloatArray,
    jacobian: FloatArray,
    *,
    current: LatentForce | None = None,
) -> LatentForce:
    """Estimate the surface along a motion (d, v), each (T,), at the element.

    respond: forces (T, m) on the element along the motion's time axis -> whitened sensor answers (R, m), in the sense
    in which the simulation would change; residual (R,): measured minus simulated, whitened; jacobian (R, P): the
    answers to everything else that is free.  `current` is the surface that the simulation already holds: the answer is
    the whole new one, so that estimate and refit can take turns.
    """
    basis, _ = np.linalg.qr(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300))
    forces = surface.forces(*motion) @ surface.free
    power = float(np.sum(forces**2)) / len(forces)
    answers = respond(forces)
    answers = answers - basis @ (basis.T @ answers)
    target = residual - basis @ (basis.T @ residual)
    if current is not None:
        target = target + answers @ (surface.free.T @ current.coefficients)
    problem = _Evidence(answers.T @ answers, answers.T @ target, float(target @ target), len(target), surface, power)
    s = problem.noise()
    weights = problem.best(s)
    mean, covariance = problem.averaged(weights, s)
    return LatentForce(
        surface=surface,
        coefficients=surface.free @ mean,
        covariance=surface.free @ covariance @ surface.free.T,
        log_evidence=problem.log_evidence(weights, s),
        noise=s,
    )


class _Evidence:
    """Evidence and posterior from the normal equations."""

    def __init__(
        self,
        gram: FloatArray,
        product: FloatArray,
        power: float,
        count: int,
        surface: Surface,
        force_power: float,
    ) -> None:
        self.gram, self.product, self.power, self.count = gram, product, power, count
        self.along_d, self.along_v = surface.roughness
        # size of the force, N: explained signal over that of a force of 1 N rms
        gain = float(np.trace(gram)) / max(force_power, 1e-300)
        self.size = max(float(np.sqrt(self._explained()[0] / max(gain, 1e-300))), 1e-12)

    def _explained(self) -> tuple[float, int]:
        """Power that the unpenalised surface explains, and with how many coefficients."""
        values, vectors = np.linalg.eigh(self.gram)
        good = values > 1e-9 * values[-1]
        return float(np.sum((vectors[:, good].T @ self.product) ** 2 / values[good])), int(good.sum())

    def precision(self, weights: tuple[float, float, float]) -> FloatArray:
        rough_d, rough_v, plain = weights
        return rough_d * self.along_d + rough_v * self.along_v + plain * np.eye(len(self.gram))

    def noise(self) -> float:
        """s from what even the unpenalised surface leaves over, never below 1."""
        explained, count = self._explained()
        return float(np.sqrt(max(1.0, (self.power - explained) / max(1, self.count - count))))

    def log_evidence(self, weights: tuple[float, float, float], s: float) -> float:
        """Log Bayes factor against no force."""
        prior = self.precision(weights)
        root = np.linalg.cholesky(prior + self.gram / s**2)
        half = scipy.linalg.solve_triangular(root, self.product / s**2, lower=True)
        ratio = np.linalg.slogdet(prior)[1] - 2 * np.sum(np.log(np.diag(root)))
        return float(0.5 * (ratio + half @ half))

    def best(self, s: float) -> tuple[float, float, float]:
        """Weights of most evidence."""
        unit = 1 / self.size**2
        least = np.log(_LEAST)

        def weights(x: FloatArray) -> tuple[float, float, float]:
            a, b, c = unit * np.exp(np.clip(x, least, 18))
            return float(a), float(b), float(c)

        def cost(x: FloatArray) -> float:
            return -self.log_evidence(weights(x), s) + 1e-3 * float(np.sum((x - np.clip(x, least, 18)) ** 2))

        starts = [np.array(x, dtype=float) for x in ((0, 0, -6), (6, 6, -6), (0, 8, -6), (8, 0, -6))]
        first = min(starts, key=cost)
        found = minimize(cost, first, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.01, "maxiter": 200})
        return weights(found.x)

    def posterior(self, weights: tuple[float, float, float], s: float) -> tuple[FloatArray, FloatArray]:
        covariance = np.asarray(np.linalg.inv(self.precision(weights) + self.gram / s**2), dtype=np.float64)
        return covariance @ (self.product / s**2), covariance

    def averaged(self, best: tuple[float, float, float], s: float) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance over weights around the best ones: what their choice leaves open belongs to the band."""
        moves = [np.zeros(3)] + [step * axis for axis in np.eye(3) for step in (-4.0, -2.0, 2.0, 4.0)]
        around = (np.array(best) * np.exp(move) for move in moves)
        trials = [(float(a), float(b), float(c)) for a, b, c in around]
        evidence = np.array([self.log_evidence(trial, s) for trial in trials])
        shares = np.exp(evidence - evidence.max())
        shares /= shares.sum()
        parts = [self.posterior(trial, s) for trial in trials]
        mean = np.sum([share * m for share, (m, _) in zip(shares, parts, strict=True)], axis=0)
        spread = [c + np.outer(m - mean, m - mean) for m, c in parts]
        return mean, np.sum([share * c for share, c in zip(shares, spread, strict=True)], axis=0)
