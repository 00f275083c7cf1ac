"""Statistics of calibration errors: which is an outlier of its kind, and priors with heavy tails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, stdtr

from sprung.model.diagnosis.fit.optimise import Fit
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.rules import PlausibleRules

_TAILS, _REWEIGHTED = 4.0, 50  # degrees of freedom of Student's t, and iterations


@dataclass(frozen=True)
class EstimatedError:
    """An error in standard deviations of its data sheet, and the standard deviation of its estimate, likewise."""

    off: float
    std: float

    def visible(self, among: int, by_chance: float) -> float:
        """Its size; 0 where the largest of so many that are none would be as large by chance."""
        return abs(self.off) if 2 * ndtr(-abs(self.off) / max(self.std, 1e-300)) * among < by_chance else 0.0


def is_outlier(fit: Fit, terms: Sequence[Term], key: tuple[str, str, str], rules: PlausibleRules) -> bool:
    """Whether an error is larger than all others, and an outlier of its kind by Student's t-test.

    terms: errors in the fit, perhaps without what they share; taken relative to the median of their kind.  How far the
    others scatter beyond their standard deviations is estimated by moments (DerSimonian and Laird 1986).
    """
    place, effect, _ = key  # the form of a lag is hardly identifiable
    away = relative_deviations(fit, terms)
    own = away.pop((place, effect), None)
    others = [one for (_, kind), one in away.items() if kind == effect]
    if own is None or len(others) < 2:
        return False
    if abs(own.off) <= rules.alone * max(one.visible(len(away), rules.by_chance) for one in away.values()):
        return False
    middle, spread = scatter_of(others)
    distance = abs(own.off - middle) / float(np.hypot(spread, own.std))
    return bool(2 * stdtr(len(others) - 1, -distance) * (len(others) + 1) < rules.by_chance)


def relative_deviations(fit: Fit, terms: Sequence[Term]) -> dict[tuple[str, str], EstimatedError]:
    """Errors by place and kind, relative to the median of their kind."""
    at = {term.key: index for index, term in enumerate(fit.point.terms)}
    away: dict[tuple[str, str], EstimatedError] = {}
    for kind in {term.law.name for term in terms}:
        alike = [term for term in terms if term.law.name == kind]
        sheet = np.array([term.scales[0] for term in alike])
        off = np.array([term.parameters[0] - term.law.absent[0] for term in alike]) / sheet
        places = [fit.place(at[term.key]).start for term in alike]
        apart = np.eye(len(alike)) - 1 / len(alike)  # what all share is less certain than how they differ
        covariance = apart @ (fit.covariance[np.ix_(places, places)] / np.outer(sheet, sheet)) @ apart
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        away |= {
            (term.location, kind): EstimatedError(float(value), float(s))
            for term, value, s in zip(alike, off - np.median(off), std, strict=True)
        }
    return away


def scatter_of(errors: Sequence[EstimatedError]) -> tuple[float, float]:
    """Mean of errors, and the standard deviation of one more of them, exactly known, about it."""
    off, variance = np.array([one.off for one in errors]), np.array([max(one.std, 1e-12) ** 2 for one in errors])
    weight = 1 / variance
    mean = float(weight @ off / np.sum(weight))
    excess = float(weight @ (off - mean) ** 2) - (len(errors) - 1)
    between = max(0.0, excess / float(np.sum(weight) - np.sum(weight**2) / np.sum(weight)))
    weight = 1 / (variance + between)
    return float(weight @ off / np.sum(weight)), float(np.sqrt(between + 1 / np.sum(weight)))


def with_heavy_tails(fit: Fit, indices: range) -> tuple[Term, ...]:
    """Errors in a fit, with Student's t in place of their Gaussian priors where nothing but these determines them.

    Factors that masses, gains and springs have in common change nothing that is measured; along them, one large error
    would pull all others.  Iteratively reweighted least squares (Holland and Welsch 1977).
    """
    terms = [fit.point.terms[index] for index in indices]
    places = [fit.place(index).start for index in indices]
    sheet, prior = np.array([(term.scales[0], term.known[0]) for term in terms]).T
    covariance = fit.covariance[np.ix_(places, places)] / np.outer(sheet, sheet)
    measured, directions = np.linalg.eigh(np.linalg.pinv(covariance, hermitian=True) - np.diag((sheet / prior) ** 2))
    free = directions[:, measured < 1]  # less is known than from the data sheets
    fitted = np.array([term.parameters[0] - term.law.absent[0] for term in terms]) / sheet
    found = fitted
    for _ in range(_REWEIGHTED if free.size else 0):
        weighted = free * ((_TAILS + 1) / (_TAILS + found**2))[:, None]
        found = fitted - free @ np.linalg.solve(weighted.T @ free, weighted.T @ fitted)
    values = zip(terms, found * sheet, strict=True)
    return tuple(replace(term, parameters=(float(term.law.absent[0] + value),)) for term, value in values)
