"""`sprung bench paper phase_information`: what spectra, and their magnitudes alone, tell of springs on moving supports.

The limit of `model.alps.phase`, whose networks may not reach it: a bound on the error of any estimator.  The response
Z = sum_i H_i U_i has the noise n, complex and Gaussian of variance s^2, that of the supports carried over.  With phases
the Fisher information about the logarithms of the stiffnesses is 2 Re (dZ* dZ') / s^2, summed over frequencies.  From
the magnitudes, r = |Z| is the length of a sum of vectors of known lengths a_i = |H_i U_i| and unknown directions, and
of noise; its density is a Hankel transform (Kluyver 1905),

    p(r) = r int_0^inf t J0(r t) prod_i J0(a_i t) exp(-s^2 t^2 / 4) dt,

and its information the mean square of d log p / d log k over drawn responses.  Both are averaged over vehicles and
inverted with the prior's (van Trees 1968).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.special import j0, j1

from sprung.benchmarks.paper_analysis import INPUTS
from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps.phase import BINS, DAMPING, MASS, NOISE, SPREAD, TOTAL
from sprung.model.signals import FloatArray

WINDOWS = 100
_STEP = 0.1  # of the integral, over the reciprocal length of the sum
_LAST = 7.0  # it ends where the noise's factor is exp(-_LAST^2 / 4)
_LONGEST = 1500.0
_DIFFERENCE = 1e-4  # of logarithms of stiffness


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per number of supports: mean relative error of a spring at the bound, and of always answering nominal."""
    for inputs in INPUTS:
        rng = np.random.default_rng([14, inputs, settings.seed])
        spectra, magnitudes = information(inputs, WINDOWS, rng)
        ratios = np.log(rng.uniform(1 - SPREAD, 1 + SPREAD, 100_000))
        told = {
            "spectra": bound(spectra, float(ratios.std())),
            "magnitudes": bound(magnitudes, float(ratios.std())),
            "guess": float(np.abs(ratios).mean()),
        }
        figures = {key: float(f"{value:.4g}") for key, value in told.items()}
        yield {"task": settings.task, "inputs": inputs, **figures, "windows": WINDOWS, "seed": settings.seed}


def bound(information: FloatArray, prior: float) -> float:
    """Mean absolute error at the bound (P, P), the prior's deviation included, of Gaussian errors."""
    covariance = np.linalg.inv(information + np.eye(len(information)) / prior**2)
    return float(np.sqrt(2 / np.pi) * np.sqrt(np.diagonal(covariance)).mean())


def information(inputs: int, windows: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Mean information about the springs' logarithms (I, I), by complex spectra and by magnitudes."""
    by_spectra, by_magnitudes = np.zeros((2, inputs, inputs))
    for _ in range(windows):
        ratio = rng.uniform(1 - SPREAD, 1 + SPREAD, inputs)
        parts = rng.standard_normal((2, len(BINS), inputs)) / np.sqrt(2)
        supports = parts[0] + 1j * parts[1]
        transfer, slope = transfers(ratio)
        clean = (transfer * supports).sum(1)
        variance = NOISE**2 * ((np.abs(clean) ** 2).mean() + (np.abs(transfer) ** 2).sum(1))  # (F,)
        change = (slope * supports[..., None]).sum(1)  # dZ / d log k, (F, I)
        by_spectra += 2 * np.real(np.einsum("fi,fj,f->ij", change.conj(), change, 1 / variance))
        noise = rng.standard_normal((2, len(BINS))) * np.sqrt(variance / 2)
        length = np.abs(clean + noise[0] + 1j * noise[1])
        lengths = np.abs(transfer * supports)
        turned = np.real(slope * transfer.conj()[..., None]) / np.abs(transfer)[..., None] * np.abs(supports)[..., None]
        score = np.einsum("fi,fij->fj", scores(length, lengths, np.sqrt(variance)), turned)
        by_magnitudes += score.T @ score
    return by_spectra / windows, by_magnitudes / windows


def transfers(ratio: FloatArray) -> tuple[Any, Any]:
    """H_i (F, I) of springs at these ratios to nominal, and their derivatives by every log k_j (F, I, I)."""

    def at(ratio: FloatArray) -> Any:
        omega = 2 * np.pi * BINS[:, None]
        stiffness = ratio * TOTAL / len(ratio)
        below = stiffness.sum() + 1j * omega * DAMPING - omega**2 * MASS
        return (stiffness + 1j * omega * DAMPING / len(ratio)) / below

    steps = np.exp(_DIFFERENCE * np.eye(len(ratio)))
    slopes = [(at(ratio * step) - at(ratio / step)) / (2 * _DIFFERENCE) for step in steps]
    return at(ratio), np.stack(slopes, axis=-1)


def scores(length: FloatArray, lengths: FloatArray, noise: FloatArray) -> FloatArray:
    """d log p(length) / d lengths (F, I): of the length (F,) of a sum of vectors and noise of deviation (F,)."""
    unit = np.sqrt((lengths**2).sum(1) + noise**2)
    length, lengths, noise = length / unit, lengths / unit[:, None], noise / unit
    t = np.arange(0, min(_LAST / noise.min(), _LONGEST), _STEP)
    common = t * j0(length[:, None] * t) * np.exp(-((noise[:, None] * t) ** 2) / 4)  # (F, N)
    arguments = lengths[..., None] * t
    factors = j0(arguments)
    # Euler-Maclaurin: the integrand rises with slope 1 from t = 0
    density = _STEP * (common * factors.prod(1)).sum(-1) + _STEP**2 / 12
    slopes = np.empty_like(lengths)
    for index in range(lengths.shape[1]):
        others = np.delete(factors, index, axis=1).prod(1)
        slopes[:, index] = -_STEP * (common * others * t * j1(arguments[:, index])).sum(-1)
    found: FloatArray = slopes / density[:, None] / unit[:, None]
    return found
