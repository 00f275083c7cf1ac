"""Evidence of models: pure functions of residuals, and the costs of parameters.

Gain of a candidate:   sum over blocks (sensor, band) of  n log(chi^2 before / chi^2 after),

twice the log-likelihood ratio with the noise level of every block profiled out, so that coloured noise of unknown
level does not count as evidence; where the noise is white and known it equals the fall of chi^2.

The signal of a sine test or a slow sweep lies in few bins.  A law that explains it may raise many quiet blocks
slightly, and in a plain sum of logarithms their number would outweigh the signal.  Losses of blocks are therefore
weighted by power: they reduce the sum of gains at most by the ratio of the rise of chi^2 in them to its fall elsewhere.
A fall of chi^2 is then never evidence against a model.

Evidence of a model, up to constants:   gain - log det(I + W C^-1 W),   W = diag(width / sqrt(2 pi))

with C the covariance of the law's parameters (Laplace's approximation with priors of `width`, MacKay 2003, chapter 28),
which is 2 log(width / (sigma sqrt(2 pi))) of a single one.  A parameter costs as much as the recording determines it;
a shape parameter without influence costs nothing, whereas BIC would charge log n for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from sprung.model.diagnosis.rules import RULES, EvidenceRules
from sprung.model.signals import FloatArray

_SINGULAR = 1e-13  # relative variance below which only rounding remains


def block_edges(bins: int, rules: EvidenceRules = RULES.evidence) -> np.ndarray:
    """Edges (blocks,) of the frequency blocks over `bins` bins, each at least one bin: [0, ..., < bins]."""
    if bins <= rules.first_block:
        return np.array([0])
    edges = np.unique(np.round(np.geomspace(rules.first_block, bins, rules.blocks)).astype(int))
    return np.concatenate([[0], edges[edges < bins]])


def profile_gain(
    before: FloatArray, after: FloatArray, sensors: int, quiet: float, rules: EvidenceRules = RULES.evidence
) -> float:
    """Gain of one whitened residual (2 F S,) over another that is weighted by the same covariance.

    Levels below `quiet` times the estimated white noise are due to coloured noise, and are no evidence.
    """
    logs, falls = _of_blocks(before, after, sensors, quiet, rules)
    return bounded_gain(logs, falls)


def process_gain(
    before: FloatArray,
    after: FloatArray,
    sensors: int,
    log_dets: tuple[float, float],
    rules: EvidenceRules = RULES.evidence,
) -> float:
    """Gain of residuals (2 F S,) weighted by covariances of their own, with the log determinants of both.

    A model with a lower noise level of the measured forces has larger weights: its blocks may rise while its
    determinant falls.  Both are parts of one likelihood, so no block is bounded.
    """
    logs, _ = _of_blocks(before, after, sensors, 0.0, rules)
    return float(np.sum(logs)) + log_dets[0] - log_dets[1]


def _of_blocks(
    before: FloatArray, after: FloatArray, sensors: int, quiet: float, rules: EvidenceRules
) -> tuple[FloatArray, FloatArray]:
    """n log(before / after) and the fall of chi-square of every block and sensor."""
    power = [(r.reshape(2, -1, sensors) ** 2).sum(axis=0) for r in (before, after)]
    bins = len(power[0])
    edges = block_edges(bins, rules)
    counts = 2.0 * np.diff(np.append(edges, bins))[:, None]
    levels = [np.maximum(np.add.reduceat(p, edges, axis=0) / counts, max(quiet, 1e-300)) for p in power]
    return counts * np.log(levels[0] / levels[1]), counts * (levels[0] - levels[1])


def bounded_gain(logs: FloatArray, falls: FloatArray) -> float:
    """Sum of logarithmic gains of blocks, with losses weighted by no more than their share of the power.

    logs, falls: n log(before / after) and the fall of chi-square of every block (K,), of the same signs.
    """
    up, down = float(np.sum(logs[logs > 0])), -float(np.sum(logs[logs < 0]))
    fall, rise = float(np.sum(falls[falls > 0])), -float(np.sum(falls[falls < 0]))
    if fall > 0 and fall >= rise:
        down = min(down, up * rise / fall)
    elif rise > 0:
        up = min(up, down * fall / rise)
    return up - down


def monotone_gains(gains: Sequence[float], left: Sequence[float], rules: EvidenceRules = RULES.evidence) -> list[float]:
    """Gains of rival fits, none above that of a fit with clearly smaller chi-square.

    Sums of logarithms weight quiet and loud blocks equally.  They may separate fits of similar chi-square, but must
    not prefer a fit to one that is clearly better.
    """
    return [
        min([gain, *(other for other, chi in zip(gains, left, strict=True) if rules.plainly * chi < own)])
        for gain, own in zip(gains, left, strict=True)
    ]


def occam_cost(
    logarithmic: Sequence[bool],
    scales: Sequence[float],
    covariance: FloatArray,
    rules: EvidenceRules = RULES.evidence,
) -> float:
    """Occam factor of free parameters: the log determinant of I + W C^-1 W, with W the widths of their priors.

    Parameters of which only a product is determined, such as a stiffness and its yield deflection, cost as much as
    that one number.

    covariance: of the parameters as they are searched, logarithms of those of unknown order, (p, p).
    """
    widths = [rules.log_width if log else rules.widths * scale for log, scale in zip(logarithmic, scales, strict=True)]
    variance = np.diag(covariance)
    free = np.isfinite(variance) & (variance > 0)
    determined = covariance[np.ix_(free, free)]
    prior = np.diag(np.array(widths)[free] ** 2 / (2 * np.pi))
    return max(0.0, _log_det(determined + prior) - _log_det(determined))


def _log_det(covariance: FloatArray) -> float:
    """Of a covariance whose entries may differ by many orders."""
    size = np.sqrt(np.diag(covariance))
    shares = np.linalg.eigvalsh(covariance / np.outer(size, size))
    return float(2 * np.sum(np.log(size)) + np.sum(np.log(np.maximum(shares, _SINGULAR))))


def unusual_cost(relative: float, usual: tuple[float, float], rules: EvidenceRules = RULES.evidence) -> float:
    """Cost of a value outside a law's usual range, where look-alikes become indistinguishable.

    relative: the value over the size at which it matters.
    """
    low, high = usual
    size = max(abs(relative), 1e-12)
    return rules.unusual * float(np.log(max(1.0, low / size, size / high)))


def chance(gain: float, freedom: int, tests: int) -> float:
    """Probability of such a gain under noise alone among `tests` candidates (Wilks, Bonferroni)."""
    return float(min(1.0, tests * stats.chi2.sf(max(gain, 0.0), max(1, freedom))))


def chance_on_whole(
    gains: Sequence[tuple[float, int]], tests: int, alpha: float, whole: float, rest: Callable[[], float]
) -> float:
    """Chance of gains on the fitted part; if the whole recording could settle what that part does not, of the whole.

    The noise of the two parts is independent, so their log-likelihood ratios add up.  Values of a candidate that is
    chance predict the rest worse than without it.

    gains: each with its degrees of freedom, all of which have to be unlikely.
    whole: length of the recording over that of the fitted part.
    rest: the gain on the rest, with the values of the fitted part; called only if it could matter.
    """

    def of(factor: float, more: float) -> float:
        return max(chance(factor * gain + more, freedom, tests) for gain, freedom in gains)

    fitted = of(1.0, 0.0)
    if fitted <= alpha or of(whole, 0.0) > alpha:
        return fitted
    return of(1.0, rest())


def bic(gain: float, parameters: int, count: int) -> float:
    """BIC with a candidate less BIC without; negative: better with it."""
    return -gain + parameters * float(np.log(max(count, 2)))


def effective_count(residual: FloatArray) -> float:
    """Effective number of independent values in a real residual (T,), by the spread of its periodogram.

    T for white noise, about four per line of a periodic error: repetitions are not independent evidence.
    """
    power = np.abs(np.fft.rfft(residual)) ** 2
    total = float(np.sum(power))
    if total <= 0:
        return float(len(residual))
    return float(min(len(residual), 4 * total**2 / float(np.sum(power**2))))


def level_gain(before: float, after: float, count: float) -> float:
    """Twice the log-likelihood ratio of two mean squares of unknown noise level, `count` numbers each."""
    return count * float(np.log(max(before, 1e-300) / max(after, 1e-300)))
