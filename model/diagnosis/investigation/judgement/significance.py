"""Significance of all findings at the end of the search, each beside all the others.

A finding is accepted beside those before it, and later ones change its value: a mass that was 12 % off beside a spring
without a gap is right beside one with it.

A gain common to all channels is not identifiable: the same rig at another size, with other values of its laws, gives
the same recording, so that only data sheets bound it.  Gains of the inputs were kept as they were before any law was
found; they are now set to the most likely common gain, and its uncertainty is added to that of the laws.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import settled
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.judgement.misfit_covariance import misfit_covariance
from sprung.model.diagnosis.investigation.measurements.calibration import calibration_indices, is_gain, shared_gain
from sprung.model.diagnosis.investigation.measurements.data_sheets import within_tolerance
from sprung.model.diagnosis.investigation.measurements.floor import leaves_more_than_noise
from sprung.model.diagnosis.investigation.search.redundant import without
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import Term, evaluated_in_time
from sprung.model.diagnosis.selection.compete import noise_bound
from sprung.model.diagnosis.selection.plausible import hardly_there, out_of_range
from sprung.model.signals import FloatArray

_STEPS = 10  # of a fit from a close start


def without_insignificant(state: Investigation) -> Investigation:
    """The investigation without findings that are not significant, or whose last values are not plausible.

    Insignificant is one whose values do not differ from those of an absent law.
    """
    if not state.found:
        return state
    state = _with_centred_gains(state)
    stated = replace(state.fit, covariance=_reported_covariance(state))
    for index in reversed(range(len(state.found))):
        at = state.given + index
        term, rules = stated.point.terms[at], state.options.rules.plausible
        doubted = hardly_there(stated, rules, at) or out_of_range(term) is not None
        if doubted and not within_tolerance(state, term):
            other = without(state, index)
            if other is not None:
                return without_insignificant(other)
    return state


def without_refuted(state: Investigation, final: Fit) -> Investigation | None:
    """The investigation without a finding that is absent from the fit to the whole recording; None if all are there."""
    rules = state.options.rules.plausible
    for index in reversed(range(len(state.found))):
        at = state.given + index
        if not within_tolerance(state, final.point.terms[at]) and hardly_there(final, rules, at):
            return without(state, index)
    return None


def shared_gain_covariance(state: Investigation) -> FloatArray:
    """Covariance of parameters and laws from the uncertainty of the gain common to all channels, (P + p, P + p)."""
    fit, (_, spread) = state.fit, shared_gain(_instruments(state))
    nothing = np.zeros_like(fit.covariance)
    if not state.calibrations or not any(
        evaluated_in_time(term) for term in fit.point.terms
    ):  # the fit contains it already
        return nothing
    other = _scaled(state, 1 + spread)
    if other is None or not np.all(np.isfinite(other.point.theta)):
        return nothing
    pairs = zip(fit.point.terms, other.point.terms, strict=True)
    moved = [np.subtract(there.parameters, here.parameters) for here, there in pairs]
    along = np.concatenate([other.point.theta - fit.point.theta, *moved])
    return np.outer(along, along)


def _reported_covariance(state: Investigation) -> FloatArray:
    """The covariance that is reported."""
    fit = state.fit
    if not exceeds_noise(state) and not leaves_more_than_noise(state):
        return fit.covariance
    return fit.covariance + misfit_covariance(state.problem, fit)


def exceeds_noise(state: Investigation) -> bool:
    """Whether chi-square says that more than noise is left: the floor of the held-out part may contain it."""
    return state.fit.reduced > noise_bound(state.problem, state.fit)


def _with_centred_gains(state: Investigation) -> Investigation:
    """The investigation with the gains of the inputs at the most likely common gain of all channels."""
    shared, spread = shared_gain(_instruments(state))
    limit = state.options.rules.fit.shared
    if not state.calibrations or abs(np.log(shared)) <= limit * spread:
        return state
    fit = _scaled(state, 1 / shared)
    return state if fit is None or fit.deviance > state.fit.deviance + 1 / limit else replace(state, fit=fit)


def _scaled(state: Investigation, factor: float) -> Fit | None:
    """The fit with all gains scaled by a factor and those of the inputs kept there; None where it diverges."""
    terms = tuple(
        replace(term, parameters=(term.parameters[0] * factor,)) if is_gain(term) else term
        for term in state.fit.point.terms
    )
    fit = try_optimise(state.problem, replace(state.fit.point, terms=terms), _STEPS)
    return None if fit is None else settled(state.problem, fit)


def _instruments(state: Investigation) -> list[Term]:
    """Gains, zeros and delays that are part of the model."""
    return [state.fit.point.terms[index] for index in calibration_indices(state)]
