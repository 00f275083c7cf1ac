"""One window of sensors, without any measured input, to parameters: band, start, fit and how well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.excitation import Excitation, Prior
from sprung.model.ambient.fit import PosteriorFit, fit
from sprung.model.ambient.periodogram import Spectra, spectra
from sprung.model.ambient.response import Responses
from sprung.model.ambient.rules import WINDOW_RULES, AmbientWindowRules
from sprung.model.ambient.sensing import Sensing
from sprung.model.ambient.whittle import Whittle
from sprung.model.identifier import PRIOR_STD
from sprung.model.signals import FloatArray
from sprung.model.system import System

SHARPEST, BLUNTEST = 0.002, 0.03  # width of a group of bins over its frequency
BLURS = (0.1, 0.01, 0.001)  # see `Whittle`; steps on the way to none
RIGID = 1e-6  # of the highest natural frequency: slower modes are motions of the whole without any spring
CERTAIN = 20.0  # degrees of freedom of a mean power from which it is known whether it stands out of the noise
SLOPE = 2  # groups of bins in which the spectrum falls where the excitation ends, and into which it leaks
LOAD_STD = 0.3  # of a body's mass that varies, where the file states no range


@dataclass(frozen=True, slots=True)
class AmbientFit:
    """Fit of one window: P unknowns, and Q free values of the excitation."""

    fitted: PosteriorFit
    spectra: Spectra
    chi_square: float  # mean square of the whitened periodograms about one, over its expectation; 1 where all is right
    chi_std: float  # its standard deviation where all is right
    per_sensor: FloatArray  # share of each sensor's rms that the model takes for noise, shape (S,)
    unknowns: int  # P: parameters, then loads

    @property
    def log_ratio(self) -> FloatArray:
        """Of the unknowns, shape (P,)."""
        return self.fitted.x[: self.unknowns]

    @property
    def covariance(self) -> FloatArray:
        """Of the log-ratios, shape (P, P)."""
        return self.fitted.covariance[: self.unknowns, : self.unknowns]

    @property
    def speed(self) -> tuple[float, float]:
        """Under a track: speed towards +x and its standard deviation, m/s."""
        slowness, std = self.fitted.x[-1], np.sqrt(self.fitted.covariance[-1, -1])
        return float(1 / slowness), float(std / slowness**2)


class WindowFit:
    """Fits windows of one system under one kind of excitation."""

    def __init__(
        self,
        system: System,
        loads: Sequence[str] = (),
        load_std: Sequence[float] = (),
        rules: AmbientWindowRules = WINDOW_RULES,
    ) -> None:
        """loads: bodies whose mass and inertias are unknown, too, with the standard deviations of their logarithms."""
        self.system, self.loads, self.rules = system, tuple(loads), rules
        P = len(system.parameters)
        self.prior_std = np.concatenate([np.full(P, PRIOR_STD), np.asarray(load_std, dtype=np.float64)])
        modes = system.mechanics.modes(system.bodies)
        fastest = max((mode.frequency for mode in modes), default=0.0)
        modes = [mode for mode in modes if mode.frequency > RIGID * fastest]
        self.lowest = min((mode.frequency for mode in modes), default=0.0)
        damping = min((mode.damping_ratio for mode in modes if mode.damping_ratio > 0), default=BLUNTEST * 5)
        self.sharpness = float(np.clip(damping / 5, SHARPEST, BLUNTEST))

    @property
    def P(self) -> int:
        return len(self.prior_std)

    def low(self, samples: int) -> float | None:
        """Lower edge of the band of a window of `samples`, Hz; None where it is too short."""
        rate = self.system.sample_rate
        low = max(self.rules.lowest * self.lowest, self.rules.periods * rate / samples)
        return None if low * 2**self.rules.octaves > self.rules.highest * rate else low

    def spectra(self, values: FloatArray, noise: FloatArray) -> Spectra | None:
        """Spectra (T, S) in the band in which a sensor stands out of its noise (S,); None where there is too little."""
        rules, rate = self.rules, self.system.sample_rate
        low = self.low(len(values))
        if low is None:
            return None
        found = spectra(values, rate, (low, rules.highest * rate), self.sharpness)
        power = np.diagonal(found.matrix, axis1=1, axis2=2).real / noise**2
        about = np.maximum(found.weight, 1e-9)
        width = np.ones(int(np.clip(np.ceil(CERTAIN / np.median(about)), 3, max(3, min(9, len(about) // 4)))))
        smooth = np.stack([np.convolve(p * about, width, "same") for p in power.T], axis=1)
        smooth /= np.convolve(about, width, "same")[:, None]
        silent = np.flatnonzero(smooth.max(axis=1) < rules.excess)
        # The band ends where the excitation does: before what the mean, the slope and its leakage reach.
        keep = np.arange(len(about)) < (silent[0] - len(width) // 2 - SLOPE if len(silent) else len(about))
        if keep.sum() < rules.groups or found.frequency[keep][-1] < low * 2**rules.octaves:
            return None
        return found.part(np.flatnonzero(keep))

    def fit(
        self,
        found: Spectra,
        sensed: Sensing,
        excitation: Excitation,
        start: FloatArray | None = None,
        blurs: tuple[float, ...] = (*BLURS, 0.0),
    ) -> PosteriorFit:
        """From `start` (the first of all unknowns and free numbers), or nominal values and what the sensors' power
        shows about the excitation."""
        responses = Responses(self.system, sensed, self.loads)
        nothing = np.zeros(self.P)
        z = excitation.start(self.power(responses, excitation, found))
        own = excitation.prior(z)
        prior = Prior(np.concatenate([nothing, own.mean]), np.concatenate([self.prior_std, own.std]))
        x = np.concatenate([nothing, z])
        if start is not None:
            x[: len(start)] = start
        for blur in blurs:
            likelihood = Whittle(responses, excitation, found, blur)
            if blur == blurs[0] and start is None:
                x = fit(likelihood, x, prior, free=np.arange(len(x)) >= self.P, limit=6).x
            fitted = fit(likelihood, x, prior, limit=12 if blur > 0 else 40)
            x = fitted.x
        return fitted

    def judged(self, fitted: PosteriorFit, found: Spectra, sensed: Sensing) -> AmbientFit:
        """A fit with its goodness of fit."""
        whitened = fitted.at.whitened
        size, spares = whitened.shape[1], len(sensed.spare)
        # Complex Wishart of m degrees of freedom: E |W - 1|^2 = R^2 / m.
        fits = (np.abs(whitened - np.eye(size)) ** 2).sum(axis=(1, 2)) * found.weight
        apart = (sensed.contradiction(found.matrix) - 1) ** 2 * found.weight[:, None]
        numbers = size**2 + spares
        statistic = (fits + apart.sum(axis=1)) / numbers
        variance = 2 / numbers + 4 / (size * found.weight)
        return AmbientFit(
            fitted=fitted,
            spectra=found,
            chi_square=float(statistic.mean()),
            chi_std=float(np.sqrt(np.mean(variance) / len(statistic))),
            per_sensor=_noise_share(fitted, found, sensed),
            unknowns=self.P,
        )

    def power(self, responses: Responses, excitation: Excitation, found: Spectra) -> FloatArray:
        """Level of the sources against that of `start(1)`, from the signals' power, (F,)."""
        A = responses.at(np.zeros(self.P), found.sides).signals
        unit = excitation.sources(excitation.start(np.ones(len(found.frequency)))).matrix
        expected = np.einsum("fsx,fxy,fsy->f", A, unit, A.conj(), optimize=True).real
        expected = (expected[: len(expected) // 2] + expected[len(expected) // 2 :]) / 2
        measured = np.einsum("fii->fi", responses.sensing.seen(found.matrix)).real
        return np.asarray(np.maximum(measured - 1, 0.05 * measured).sum(axis=1) / expected)


def _noise_share(fitted: PosteriorFit, found: Spectra, sensed: Sensing) -> FloatArray:
    """Share of every sensor's rms that the model takes for noise, (S,): the residual of the most likely motion."""
    left = sensed.rows.T @ np.linalg.inv(fitted.at.covariance) @ sensed.rows + sensed.spare.T @ sensed.spare
    left = sensed.noise[:, None] ** 2 * left  # R S^-1, (F, S, S)
    error = np.einsum("f,fij,fjk,fik->i", found.weight, left, found.matrix, left.conj(), optimize=True).real
    whole = np.einsum("f,fii->i", found.weight, found.matrix).real
    return np.asarray(np.sqrt(np.maximum(error, 0.0) / whole))
