"""Whether the zero of a load cell drifts in the course of a component test.

A slow drift is no force that a motion makes, so that no law explains it, and beside it none is seen to leave only
noise.  The laws are therefore sought once more with a drift among what is given.  A law with a long memory imitates a
drift by the decay of what happened before the record, and explains slow forces by the motion if it is the true one.
So a drift counts only if it is most of what the laws beside it leave at low frequencies, and if it and these laws are
likelier than laws without it; where it is as likely, the law is named with the drift as its look-alike (`alike`).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.fft import dct

from sprung.model.diagnosis.force.fit import ComponentFit, ComponentModel, fitted, refined
from sprung.model.diagnosis.force.motion import turning_points
from sprung.model.diagnosis.force.search import Search
from sprung.model.diagnosis.force.zero_drift import ZeroDrift
from sprung.model.diagnosis.selection.evidence import bic, chance, effective_count, level_gain


def possible_drift(found: Search, given: ComponentModel) -> ZeroDrift | None:
    """The drift that the linear model, or the laws found or all but one of them, leave; None without any."""
    fit, rules = found.final, found.final.task.rules
    if found.base.at_noise:
        return None
    laws = range(len(given.pieces), len(fit.model.pieces))
    quick = fit.task.thinned(rules.search)
    best, least = None, np.inf
    for model in (given, fit.model, *(fit.model.without(index) for index in laws)):
        before = fitted(quick, model)
        after, cost = _likeliest((fitted(quick, model.plus(drift, ())) for drift in _drifts(before)), before)
        if after is not None and cost < least and _stands_out(after, before):
            best, least = _drift_of(after), cost
    return best


def drifts(beside: Search, without: Search, given: ComponentModel) -> bool:
    """Whether laws beside a drift, the last one `given`, are likelier than laws without, and the drift stands out."""
    fit, other, rules = beside.final, without.final, beside.final.task.rules
    if not _stands_out(fit, refined(fit.task, fit.model.without(len(given.pieces) - 1))):
        return False
    count = effective_count(fit.residual[: fit.task.split])
    cost = bic(level_gain(other.error, fit.error, count), fit.model.count - other.model.count, int(count))
    return cost < -rules.naming_margin and (fit.at_noise or fit.held_out <= rules.as_well * other.held_out)


def with_drift_instead(fit: ComponentFit, index: int) -> ComponentFit | None:
    """The fit with a drift in place of a law; None if it has a drift already, or the record is too short for one."""
    if any(fit.model.wandering):
        return None
    others = (refined(fit.task, fit.model.replaced(index, drift, ())) for drift in _drifts(fit))
    return _likeliest(others, fit)[0]


def _drifts(fit: ComponentFit) -> list[ZeroDrift]:
    """Drifts that are slower than the motion, the plainest first."""
    motion, rules = fit.task.motion, fit.task.rules
    turns = turning_points(motion.deflection, rules.turn * float(np.ptp(motion.deflection)))
    return [ZeroDrift(powers=n + 1) for n in range(min(rules.drift_powers, int(len(turns) / rules.drift_turns)))]


def _drift_of(fit: ComponentFit) -> ZeroDrift:
    return next(piece for piece in fit.model.pieces if isinstance(piece, ZeroDrift))


def _likeliest(fits: Iterable[ComponentFit], before: ComponentFit) -> tuple[ComponentFit | None, float]:
    """Of fits with drifts the one that has the most evidence at low frequencies, and its BIC over a fit without."""
    count = before.task.rules.slow
    costs = [(bic(_slow_gain(fit, before), _drift_of(fit).powers, count), fit) for fit in fits]
    cost, fit = min(costs, key=lambda one: one[0], default=(np.inf, None))
    return fit, cost


def _stands_out(after: ComponentFit, before: ComponentFit) -> bool:
    """Whether a drift is most of what is left without it at low frequencies."""
    gain, rules = _slow_gain(after, before), after.task.rules
    most = level_gain(1.0, 1.0 - rules.named, rules.slow)
    return gain > most and chance(gain, _drift_of(after).powers, 1) < rules.alpha


def _slow_gain(after: ComponentFit, before: ComponentFit) -> float:
    """Gain by a drift over the slowest changes of the whole record."""
    count = after.task.rules.slow
    slow = [dct(fit.residual, norm="ortho")[1 : count + 1] for fit in (before, after)]
    return level_gain(float(slow[0] @ slow[0]), float(slow[1] @ slow[1]), count)
