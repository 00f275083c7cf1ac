"""Findings once more when the search is over: whether each still differs from nothing beside all the others.

A finding is accepted beside those before it, and what comes later changes what it stands for: a mass that was 12 % off
beside a spring without its gap is right beside one with it.

What all channels show too large, the same rig shows at another size, and laws with other values explain it as well: it
is known by data sheets alone.  Gains of what drives everything were kept as they were before any law was found.  So
they are brought to where the gains of all channels are least far off together, and values of laws are as uncertain as
this shared gain makes them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import settled
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.calibration import channels, in_order, is_gain, shared_gain
from sprung.model.diagnosis.investigation.doubt import by_what_is_left
from sprung.model.diagnosis.investigation.idle import without
from sprung.model.diagnosis.investigation.judgement import leaves_more_than_noise
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import Term, is_waveform
from sprung.model.diagnosis.selection.plausible import hardly_there
from sprung.model.signals import FloatArray

_STEPS = 10  # of a fit that begins near
_NEAR = 0.2  # deviations of the shared gain, within which it stays


def standing(state: Investigation) -> Investigation:
    """An investigation whose findings all differ from nothing by their deviations; those that do not are taken out."""
    if not state.found:
        return state
    state = _centred(state)
    stated = replace(state.fit, covariance=_stated(state))
    for index in reversed(range(len(state.found))):
        at = state.given + index
        if not in_order(state, stated.point.terms[at]) and hardly_there(stated, state.options.rules.plausible, at):
            other = without(state, index)
            if other is not None:
                return standing(other)
    return state


def by_shared_gain(state: Investigation) -> FloatArray:
    """What the gain that all channels share leaves open of parameters and laws, a covariance, (P + p, P + p)."""
    fit, (_, spread) = state.fit, shared_gain(_instruments(state))
    nothing = np.zeros_like(fit.covariance)
    if not state.calibrations or not any(is_waveform(term) for term in fit.point.terms):  # else the fit itself tells
        return nothing
    other = _scaled(state, 1 + spread)
    if other is None or not np.all(np.isfinite(other.point.theta)):
        return nothing
    pairs = zip(fit.point.terms, other.point.terms, strict=True)
    moved = [np.subtract(there.parameters, here.parameters) for here, there in pairs]
    along = np.concatenate([other.point.theta - fit.point.theta, *moved])
    return np.outer(along, along)


def _stated(state: Investigation) -> FloatArray:
    """The covariance that a report states."""
    covariance = state.fit.covariance
    return covariance + by_what_is_left(state.problem, state.fit) if leaves_more_than_noise(state) else covariance


def _centred(state: Investigation) -> Investigation:
    """The fit with the gains of what drives everything where all gains together are least far off."""
    shared, spread = shared_gain(_instruments(state))
    if not state.calibrations or abs(np.log(shared)) <= _NEAR * spread:
        return state
    fit = _scaled(state, 1 / shared)
    return state if fit is None or fit.deviance > state.fit.deviance + 1 / _NEAR else replace(state, fit=fit)


def _scaled(state: Investigation, factor: float) -> Fit | None:
    """The fit with all gains scaled alike and those of what drives everything kept there; None where it diverges."""
    terms = tuple(
        replace(term, parameters=(term.parameters[0] * factor,)) if is_gain(term) else term
        for term in state.fit.point.terms
    )
    fit = try_optimise(state.problem, replace(state.fit.point, terms=terms), _STEPS)
    return None if fit is None else settled(state.problem, fit)


def _instruments(state: Investigation) -> list[Term]:
    """Gains, zeros and delays that are part of the model."""
    return [state.fit.point.terms[index] for index in channels(state)]
