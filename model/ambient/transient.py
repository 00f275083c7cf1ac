"""Output-only windows of a structure: transients at their ends are modelled instead of tapered.

The transform of a whole window, without taper, of a structure under unmeasured white forces W is exactly

    Y(w) = A(w) W(w) + T(w) b + V(w),      S(w) = A(w) diag(L) A(w)^H + r^2

with A the signals per force, V the sensors' noise, and T b what the state at the window's start leaves over that at its
end: impulses and steps of every degree of freedom, A and j w A, with real coefficients b.  A few powers of j w in every
signal take what leaks from outside the band, and what sampling folds back into it.  b is projected out, so that a free
decay (L next to nothing), a shaken structure and everything between are one case, and a window of some ten periods
determines a frequency far more closely than its bins are spaced.  (Pintelon, Schoukens: transients of finite records;
the likelihood is Whittle's.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from sprung.model.ambient.excitation import Prior
from sprung.model.ambient.fit import PosteriorFit, fit
from sprung.model.ambient.response import Response, Responses
from sprung.model.ambient.rules import WINDOW_RULES, AmbientWindowRules
from sprung.model.ambient.sensing import Sensing, sensing
from sprung.model.ambient.whittle import Evaluation, adjoint
from sprung.model.identifier import PRIOR_STD
from sprung.model.mechanics import Mode
from sprung.model.signals import FloatArray
from sprung.model.system import System

LEAKS = (-1, 0, 1, 2, 3)  # powers of j w: from below the band, from above, and of what sampling folds back
DECAYING = 15.0  # logarithm by which forces are weaker when a free decay is tried
FIRST, LAST = 20, 100  # steps from every start, and from the best of them
LEVEL_STD = 3.0  # of the logarithm of a force's level about the one estimated from the signals' power
NOISE_STD = 3.0  # of that of the noise power about the declared one
STIFFER = np.linspace(-1.0, 1.0, 41)  # common log-ratios of all stiffnesses that are tried as starts
BLURRED = 0.15  # damping ratio with which they are compared first


@dataclass(frozen=True, slots=True)
class TransientFit:
    """Fit of one window."""

    fitted: (
        PosteriorFit  # x: log-ratios, log-levels of the forces' power, logarithm of the noise power over the declared
    )
    frequency: FloatArray  # of the compared bins, Hz, shape (F,)
    whole: FloatArray  # power of every sensor's bins, shape (F, S)
    rest: FloatArray  # of it without the transients of the ends, shape (F, S)
    expected: FloatArray  # of the rest, by the model, shape (F, S)
    noise_share: FloatArray  # of every sensor's rms that the model takes for noise, shape (S,)
    misfit: float  # largest deviation of a part of the band from its expectation, in standard deviations
    rules: AmbientWindowRules = WINDOW_RULES

    @property
    def adequate(self) -> bool:
        """Whether the structure explains the window."""
        return bool(self.misfit < -ndtri(self.rules.misjudged / self.rules.parts) and self.fitted.converged)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of x; misfit counts as additional noise."""
        return self.fitted.covariance * self.chi_square

    @property
    def chi_square(self) -> float:
        """Of the worst part of the band over that of a good fit's; at least 1."""
        return max(1.0, self.misfit / self.rules.usual) ** 2


@dataclass(frozen=True, slots=True)
class _Whitened:
    """The bins at one point."""

    response: Response
    white: np.ndarray  # S^-1/2, (F, R, R)
    basis: FloatArray  # orthonormal, of the transients, (2 F R, 2 n + leaks R)
    ends: FloatArray  # b, (2 n + leaks R,)
    residual: np.ndarray  # (F, R)
    cost: float


class TransientLikelihood:
    """The likelihood of one window's bins."""

    def __init__(self, responses: Responses, signals: np.ndarray, omega: FloatArray) -> None:
        """signals: transforms of unit-noise signals, (F, R)."""
        self.responses, self.signals, self.omega = responses, signals, omega
        self.P, self.n = len(responses.unknowns), responses.mechanics.n
        along = 1j * omega[:, None] / omega[-1]
        smooth = np.concatenate([along**power for power in LEAKS], axis=1)  # (F, leaks)
        self.leaks = np.einsum("fl,rs->frls", smooth, np.eye(signals.shape[1])).reshape(*signals.shape, -1)

    def evaluate(self, x: FloatArray) -> Evaluation:
        """Everything that a step of Fisher scoring needs."""
        at = self._at(x)
        A, white, e = at.response.signals, at.white, at.residual
        level, noise = np.exp(x[self.P : -1]), float(np.exp(x[-1]))
        jw, WA = 1j * self.omega[:, None], white @ A
        ends = at.ends[: self.n] + jw * at.ends[self.n : 2 * self.n]  # (F, n)
        D, moved = [], []
        for p in range(self.P):
            dA = white @ (at.response.per_force * at.response.factor[:, p][:, None, :]) @ at.response.motion
            half = (dA * level) @ adjoint(WA)
            D.append(half + adjoint(half))
            moved.append(np.einsum("frn,fn->fr", dA, ends))
        D += [level[i] * WA[:, :, i, None] * WA[:, None, :, i].conj() for i in range(self.n)]
        D.append(noise * white @ adjoint(white))
        moved += [np.zeros_like(e)] * (self.n + 1)
        change, M = np.stack(D), np.stack([_real(one) for one in moved], axis=1)
        M -= at.basis @ (at.basis.T @ M)
        slope = np.einsum("xfrr->x", change).real - np.einsum("fr,xfrs,fs->x", e.conj(), change, e).real
        flat = change.reshape(len(change), -1)
        information = (flat @ flat.conj().T).real + 2 * M.T @ M
        S = (A * level) @ adjoint(A) + noise * np.eye(A.shape[1])
        whitened = e[:, :, None] * e[:, None, :].conj()
        return Evaluation(at.cost, slope - 2 * _real(e) @ M, information, whitened, S, S)

    def cost(self, x: FloatArray) -> float:
        """The negative log-likelihood alone."""
        return self._at(x).cost

    def _at(self, x: FloatArray) -> _Whitened:
        """The whitened bins at a point, with the transients of the ends projected out."""
        response = self.responses.at(x[: self.P], self.omega)
        A, jw = response.signals, (1j * self.omega)[:, None, None]
        S = (A * np.exp(x[self.P : -1])) @ adjoint(A) + np.exp(x[-1]) * np.eye(A.shape[1])
        factor = np.linalg.cholesky(S)
        white = np.linalg.inv(factor)
        columns = white @ np.concatenate([A, jw * A, self.leaks], axis=2)
        scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=(0, 1)))
        basis, triangle = np.linalg.qr(_real(columns / scale))
        bins = (white @ self.signals[:, :, None])[:, :, 0]
        ends = np.linalg.lstsq(triangle, basis.T @ _real(bins), rcond=1e-12)[0] / scale
        residual = bins - (columns @ ends[:, None])[:, :, 0]
        log_det = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2).real).sum()
        return _Whitened(response, white, basis, ends, residual, float(log_det + np.sum(np.abs(residual) ** 2)))


def _real(series: np.ndarray) -> FloatArray:
    """Complex (F, R, ...) as real (2 F R, ...)."""
    flat = series.reshape(-1, *series.shape[2:])
    return np.concatenate([flat.real, flat.imag])


class TransientWindow:
    """Fits windows of one system without inputs."""

    def __init__(self, system: System, rules: AmbientWindowRules = WINDOW_RULES) -> None:
        self.system, self.rules = system, rules
        self.modes = elastic(system)

    def bins(self, samples: int) -> FloatArray:
        """Frequencies that are compared, Hz; empty where a window is too short."""
        rate = self.system.sample_rate
        if not self.modes:
            return np.zeros(0)
        low = max(self.rules.below * self.modes[0].frequency, 2 * rate / samples)
        high = min(self.rules.above * self.modes[-1].frequency, self.rules.nyquist * rate)
        frequency = np.fft.rfftfreq(samples, 1 / rate)
        return np.asarray(frequency[(frequency >= low) & (frequency <= high)])

    def fit(
        self, values: FloatArray, sensors: np.ndarray, start: FloatArray | None = None, known: FloatArray | None = None
    ) -> TransientFit | None:
        """The fit of a window (T, S) of the sensors at these indices; None if it is too short or too quiet.

        start: initial log-ratios (P,).  known: fixed log-ratios (P,); only levels are estimated.
        """
        frequency = self.bins(len(values))
        if len(frequency) < max(self.rules.bins, len(self.system.parameters) + 2):
            return None
        sensed = sensing(self.system.mechanics, sensors, self.system.sensor_noise[sensors])
        spectrum = np.fft.rfft(values - values.mean(axis=0), axis=0, norm="ortho")
        first = round(frequency[0] * len(values) / self.system.sample_rate)
        signals = spectrum[first : first + len(frequency)] @ sensed.rows.T
        if np.mean(np.abs(signals) ** 2, axis=0).max() < 2:
            return None
        fitted = self._fit(sensed, signals, 2 * np.pi * frequency, start, known)
        whole = np.abs(spectrum[first : first + len(frequency)]) ** 2
        return _judged(fitted, frequency, whole, sensed, self.rules)

    def _fit(
        self,
        sensed: Sensing,
        signals: np.ndarray,
        omega: FloatArray,
        start: FloatArray | None,
        known: FloatArray | None,
    ) -> PosteriorFit:
        responses = Responses(self.system, sensed)
        likelihood = TransientLikelihood(responses, signals, omega)
        P, n = likelihood.P, likelihood.n
        level = self._level(responses, signals, likelihood.omega)
        mean = np.concatenate([np.zeros(P), level, [0.0]])
        std = np.concatenate([np.full(P, PRIOR_STD), np.full(n, LEVEL_STD), [NOISE_STD]])
        prior = Prior(mean, std)
        if known is not None:
            return fit(likelihood, np.concatenate([known, mean[P:]]), prior, free=np.arange(len(mean)) >= P)
        tried = [fit(likelihood, x, prior, limit=FIRST) for x in self._starts(likelihood, mean, start)]
        best = min(tried, key=lambda one: one.cost)
        return best if best.converged else fit(likelihood, best.x, prior, limit=LAST)

    def _starts(
        self, likelihood: TransientLikelihood, mean: FloatArray, start: FloatArray | None
    ) -> Iterator[FloatArray]:
        """The given start, and the common stiffness that fits best while modes are blurred."""
        if start is not None:
            yield np.concatenate([start, mean[len(start) :]])
        stiff = np.array([p.quantity == "stiffness" for p in self.system.parameters])
        if not stiff.any():
            yield mean
            return
        damping = np.array([p.quantity == "damping" for p in self.system.parameters])
        least = min(mode.damping_ratio for mode in self.modes)
        blur = np.log(max(BLURRED / max(least, 1e-3), 1.0))
        for wide in (0.0, blur):
            tried = [mean + np.concatenate([g * stiff + wide * damping, np.zeros(likelihood.n + 1)]) for g in STIFFER]
            best = tried[int(np.argmin([likelihood.cost(x) for x in tried]))].copy()
            best[: likelihood.P][damping] -= 0.5 * wide
            yield best.copy()
            if not wide:  # as a free decay
                best[likelihood.P : -1] -= DECAYING
                yield best.copy()

    def _level(self, responses: Responses, signals: np.ndarray, omega: FloatArray) -> FloatArray:
        """Logarithm of the forces' power under which the signals have theirs, with one acceleration for all, (n,)."""
        A = responses.at(np.zeros(len(responses.unknowns)), omega).signals
        inertia = self.system.mechanics.mass
        expected = np.sum(np.abs(A) ** 2 * inertia**2)
        measured = max(float(np.sum(np.abs(signals) ** 2) - signals.size), 0.05 * float(np.sum(np.abs(signals) ** 2)))
        found: FloatArray = np.log(measured / expected) + 2 * np.log(inertia)
        return found


def _judged(
    fitted: PosteriorFit, frequency: FloatArray, whole: FloatArray, sensed: Sensing, rules: AmbientWindowRules
) -> TransientFit:
    """How well the power in parts of the band is the expected one."""
    at = fitted.at
    white = np.einsum("frr->fr", at.whitened).real
    parts = np.array_split(np.arange(len(frequency)), min(rules.parts, max(1, len(frequency) // 4)))
    deviation = [np.abs(white[part].mean(axis=0) - 1) * np.sqrt(len(part)) for part in parts]
    factor, back = np.linalg.cholesky(at.covariance), np.linalg.pinv(sensed.rows)
    rest = back @ factor @ at.whitened @ adjoint(back @ factor)
    noise = np.exp(fitted.x[-1] / 2) * sensed.noise / np.sqrt(np.maximum(whole.mean(axis=0), 1e-300))
    return TransientFit(
        fitted=fitted,
        frequency=frequency,
        whole=whole,
        rest=np.einsum("fss->fs", rest).real,
        expected=np.einsum("fss->fs", back @ at.covariance @ back.T).real,
        noise_share=np.minimum(noise, 1.0),
        misfit=float(np.max(deviation)),
        rules=rules,
    )


def elastic(system: System) -> list[Mode]:
    """Natural modes with springs in them, by frequency."""
    modes = sorted(system.mechanics.modes(system.bodies), key=lambda mode: mode.frequency)
    fastest = modes[-1].frequency if modes else 0.0
    return [mode for mode in modes if mode.frequency > 1e-6 * fastest]
