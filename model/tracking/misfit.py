"""Do windows still fit?

Three things speak against: the estimator's verdict on a window, residual power above the vehicle's own noise floor,
and estimates of neighbouring windows that contradict each other.  The last finds what one window cannot: a law that
was left out lets each window fit with parameters of its own (hysteresis, for one).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sprung.model.tracking.rules import TRACKING_RULES, MisfitRules


@dataclass(frozen=True, slots=True)
class MisfitFloor:
    """Noise floor of log chi-square (mean and spread over learning) and a one-sided Page test on it."""

    windows: int = 0  # that the floor was learned from
    mean: float = 0.0
    moment: float = 0.0  # sum of squared deviations (Welford)
    statistic: float = 0.0
    rising_since: int = 0  # ns, when the statistic last left zero
    misfit_since: int | None = None  # ns; None: windows fit

    def shifted(self, by: int) -> MisfitFloor:
        """With times that are later by `by`, ns."""
        since = None if self.misfit_since is None else self.misfit_since + by
        return replace(self, rising_since=self.rising_since + by, misfit_since=since)


def update(
    fit: MisfitFloor,
    chi_square: float,
    *,
    adequate: bool,
    inflation: float,
    time: int,
    rules: MisfitRules = TRACKING_RULES.misfit,
) -> MisfitFloor:
    """After one window; `time` in ns, `inflation` the largest scatter of a parameter over what windows state.

    The floor is learned from the first adequate windows of the vehicle and then stays: a floor that
    went on learning would follow a slow rise.
    """
    usable = math.isfinite(chi_square) and chi_square > 0
    level = math.log(chi_square) if usable else math.inf
    if adequate and usable and fit.windows < rules.windows:
        count = fit.windows + 1
        mean = fit.mean + (level - fit.mean) / count
        fit = replace(fit, windows=count, mean=mean, moment=fit.moment + (level - fit.mean) * (level - mean))
    score = rules.most
    contradicting = inflation >= (rules.contradiction if fit.misfit_since is None else rules.agreement)
    if adequate and usable and not contradicting:
        spread = max(rules.spread, math.sqrt(fit.moment / max(fit.windows - 1, 1)))
        score = min(rules.most, (level - fit.mean) / spread) if fit.windows else 0.0
    statistic = min(max(0.0, fit.statistic + max(score, -rules.most) - rules.reference), 1.5 * rules.threshold)
    rising = time if fit.statistic == 0 and statistic > 0 else fit.rising_since
    since = fit.misfit_since
    if since is None and statistic >= rules.threshold:
        since = rising
    elif since is not None and statistic == 0:
        since = None
    return replace(fit, statistic=statistic, rising_since=rising, misfit_since=since)
