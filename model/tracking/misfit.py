"""Do windows still fit?

Three things speak against: the estimator's verdict on a window, residual power above the vehicle's own noise floor,
and estimates of neighbouring windows that contradict each other.  The last finds what one window cannot: a law that
was left out lets each window fit with parameters of its own (hysteresis, for one).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

REFERENCE = 2.0  # standard deviations above the floor that count as normal
MOST = 4.0  # one window adds at most this less REFERENCE
THRESHOLD = 20.0  # so ten windows in a row at least; 2 h k = 80: Gaussian scatter alone never gets there
CONTRADICTION = 2.5  # scatter over what windows state, as variances; by chance 1 + 6 standard deviations of 60 pairs
AGREEMENT = 1.8  # once contradicting, windows agree again below this
FLOOR_WINDOWS = 60  # that the floor is learned from, whatever they identify: a spread known to a tenth
LEAST_SPREAD = 0.1  # of log chi-square; windows of one vehicle differ by that with speed and track


@dataclass(frozen=True, slots=True)
class MisfitFloor:
    """Noise floor of log chi-square (mean and spread over learning) and a one-sided Page test on it."""

    windows: int = 0  # that the floor was learned from
    mean: float = 0.0
    moment: float = 0.0  # sum of squared deviations (Welford)
    statistic: float = 0.0
    rising_since: int = 0  # ns, when the statistic last left zero
    misfit_since: int | None = None  # ns; None: windows fit


def update(fit: MisfitFloor, chi_square: float, *, adequate: bool, inflation: float, time: int) -> MisfitFloor:
    """After one window; `time` in ns, `inflation` the largest scatter of a parameter over what windows state.

    The floor is learned from the first `FLOOR_WINDOWS` adequate windows of the vehicle and then stays: a floor that
    went on learning would follow a slow rise.
    """
    usable = math.isfinite(chi_square) and chi_square > 0
    level = math.log(chi_square) if usable else math.inf
    if adequate and usable and fit.windows < FLOOR_WINDOWS:
        count = fit.windows + 1
        mean = fit.mean + (level - fit.mean) / count
        fit = replace(fit, windows=count, mean=mean, moment=fit.moment + (level - fit.mean) * (level - mean))
    score = MOST
    contradicting = inflation >= (CONTRADICTION if fit.misfit_since is None else AGREEMENT)
    if adequate and usable and not contradicting:
        spread = max(LEAST_SPREAD, math.sqrt(fit.moment / max(fit.windows - 1, 1)))
        score = min(MOST, (level - fit.mean) / spread) if fit.windows else 0.0
    statistic = min(max(0.0, fit.statistic + max(score, -MOST) - REFERENCE), 1.5 * THRESHOLD)
    rising = time if fit.statistic == 0 and statistic > 0 else fit.rising_since
    since = fit.misfit_since
    if since is None and statistic >= THRESHOLD:
        since = rising
    elif since is not None and statistic == 0:
        since = None
    return replace(fit, statistic=statistic, rising_since=rising, misfit_since=since)
