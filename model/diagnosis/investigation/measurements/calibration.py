"""Calibration errors: gains, zeros and delays within the tolerances of data sheets are part of the model, not faults.

No rig has exact gains and zeros and exactly simultaneous samples.  With little noise a gain error of one per cent or a
delay of a hundredth of a sample is significant, and other laws that imitate it, such as a hung mass or an elastic mode,
fit a little better.  Once one is found, gains, zeros and delays of all sensors, gains and zeros of measured forces, and
masses of all bodies, none of which is weighed better than an instrument shows, become parameters of the model with the
tolerances as prior (`gain_std`, `offset_std`, `delay_std` of an address), and the search restarts.  Values within
tolerance are reported and have no effect on the verdict; their uncertainty is part of that of all other values.

With enough channels, one whose error is far larger than all others of its kind is a fault, however small: the
instruments of one rig are comparable.  Where laws are missing, errors make up for them: such a fault is named only if
the model leaves no more than noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.baseline import refreshed
from sprung.model.diagnosis.fit.misfit import misfit
from sprung.model.diagnosis.fit.optimise import Fit, try_optimise
from sprung.model.diagnosis.investigation.measurements.data_sheets import (
    calibration_terms,
    freed_beyond_tolerance,
    within_tolerance,
)
from sprung.model.diagnosis.investigation.measurements.floor import leaves_more_than_noise
from sprung.model.diagnosis.investigation.measurements.outliers import is_outlier, with_heavy_tails
from sprung.model.diagnosis.investigation.state import AcceptedFinding, Investigation
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.screening.score import Screening
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.along_measured import disturbed
from sprung.model.diagnosis.selection.plausible import hardly_there, out_of_range

_STEPS = 12  # of a fit of the structure with the calibration
_PASSES = 3  # of such fits, with those beyond their tolerance freed after each


def is_gain(term: Term) -> bool:
    """Whether a term is a gain that may be a calibration error."""
    return term.law.of_instrument is not None and term.law.slope().gain != 0


def shared_gain(terms: Sequence[Term]) -> tuple[float, float]:
    """Most likely common gain of the terms with a tolerance, and its standard deviation; 1 and 0 without any."""
    gains = [(term.parameters[0], term.known[0]) for term in terms if term.known and is_gain(term)]
    if not gains:
        return 1.0, 0.0
    weights = np.array([1 / spread**2 for _, spread in gains])
    logs = np.log(np.maximum([gain for gain, _ in gains], 1e-3))
    return float(np.exp(weights @ logs / np.sum(weights))), float(np.sum(weights) ** -0.5)


def centred(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Terms with their gains divided by the common one, which is not identifiable.

    The same rig at another size, with other values of its laws, gives the same recording.
    """
    shared, _ = shared_gain(terms)
    return tuple(
        replace(term, parameters=(term.parameters[0] / shared,)) if term.known and is_gain(term) else term
        for term in terms
    )


def calibrated(state: Investigation, first: Term) -> Investigation:
    """The investigation with the calibration errors of all channels and bodies in its model, its search begun anew.

    first: the first that was found; if it is an outlier, it is a fault, and the model is not changed.
    Gains of the inputs are kept fixed from now on: their common part is only identifiable from the curvature of a law.
    """
    file, terms = state.fit.point.terms[: state.given], calibration_terms(state)
    keys = {term.key for term in terms}
    beyond = state.fit.point.terms[state.given :]
    laws = tuple(one for one, term in zip(state.found, beyond, strict=True) if term.key not in keys)
    found = tuple(term for term in beyond if term.key not in keys)
    problem = state.problem
    for _ in range(_PASSES):
        fit = try_optimise(problem, replace(state.fit.point, terms=(*file, *terms, *found)), _STEPS)
        if fit is None:
            return replace(state, calibrations=0)
        if problem.process_noise:  # beside a strong unmeasured force, which they make up for, values are rough
            problem, fit = refreshed(problem, fit)
        fitted = with_heavy_tails(fit, range(len(file), len(file) + len(terms)))
        fitted = fitted if _anchored(state, fitted) else centred(fitted)
        alone = is_outlier(fit, fitted, first.key, state.options.rules.plausible)
        with_them = replace(state, problem=problem, fit=fit, held=replace(state.held, noise=problem.noise))
        if alone and not leaves_more_than_noise(with_them):
            return replace(state, calibrations=0)
        if any(out_of_range(term) for term in fitted):
            return replace(state, calibrations=0)  # no errors, but another structure
        terms = tuple(freed_beyond_tolerance(state, fitted))
        if [term.known for term in terms] == [term.known for term in fitted]:
            break
    held = tuple(replace(term, fixed=(True,)) for term in terms)  # else they absorb part of the missing law
    problem = replace(state.problem, noise=state.base.noise)
    base = try_optimise(problem, replace(state.base.point, terms=(*state.base.point.terms, *held)), _STEPS)
    if base is None:
        return replace(state, calibrations=0)
    problem, base = refreshed(problem, base)
    screening = screen(problem, base, state.problem.system.catalogue, state.options.project)
    begun = replace(state, problem=problem, base=base, fit=base, found=(), first=screening, last=screening, wider=None)
    begun = replace(begun, held=replace(state.held, noise=problem.noise), calibrations=len(held))
    if found and disturbed(problem.system):
        return _with_laws_kept(begun, with_them, laws)
    if float(np.max(misfit(base))) > state.options.rules.setup.misfit:
        return begun  # fixed until the missing law is found: before, they would diverge
    base = with_free_gains(begun, base)
    return replace(begun, base=base, fit=base)


def _with_laws_kept(begun: Investigation, beside: Investigation, laws: tuple[AcceptedFinding, ...]) -> Investigation:
    """A search begun anew with calibration errors, which goes on beside the laws that were found.

    Along a motion that the sensors saw, unmeasured forces are whatever masses, gains and springs do not explain: beside
    free gains and masses no law shows in them, but those that were found without these are right beside them.
    """
    problem, fit = beside.problem, with_free_gains(begun, beside.fit)
    last = screen(problem, fit, problem.system.catalogue, begun.options.project)
    return replace(begun, problem=problem, fit=fit, held=beside.held, found=laws, last=last)


def _anchored(state: Investigation, terms: Sequence[Term]) -> bool:
    """Whether a measured force, held exact, determines the gains that others have in common."""
    free = {term.location for term in terms if is_gain(term)}
    return any(name not in free for name in state.signals.force_names)


def with_free_gains(state: Investigation, fit: Fit) -> Fit:
    """A fit with masses, and gains, zeros and delays of sensors free; those of the inputs stay fixed."""
    sensors, terms = state.signals.sensor_names, list(fit.point.terms)
    for index in calibration_indices(state):
        if terms[index].location in sensors or terms[index].law.scales:
            terms[index] = replace(terms[index], fixed=())
    return replace(fit, point=replace(fit.point, terms=tuple(terms)))


def calibration_indices(state: Investigation) -> range:
    """Indices of the terms of the investigation's fits that are calibration errors: the last of the given ones."""
    return range(state.given - (state.calibrations or 0), state.given)


def without_calibrations(state: Investigation) -> Screening:
    """The last screening without calibration errors that are in the model, whose rest is rounding."""
    among = {state.fit.point.terms[index].key[:2] for index in calibration_indices(state)}
    kept = tuple(candidate for candidate in state.last.candidates if candidate.term.key[:2] not in among)
    return replace(state.last, candidates=kept)


def faulty(state: Investigation) -> list[int]:
    """Indices of calibration errors that are significantly beyond their tolerance beside all findings, or outliers."""
    fit, rules = state.fit, state.options.rules.plausible
    beyond = (index for index in calibration_indices(state) if not within_tolerance(state, fit.point.terms[index]))
    return sorted({*(index for index in beyond if not hardly_there(fit, rules, index)), *_outliers(state)})


def _outliers(state: Investigation) -> list[int]:
    """Indices of calibration errors that are outliers of their kind beside all findings."""
    free = [index for index in calibration_indices(state) if not state.fit.point.terms[index].fixed]
    terms, rules = [state.fit.point.terms[index] for index in free], state.options.rules.plausible
    alone = [index for index in free if is_outlier(state.fit, terms, state.fit.point.terms[index].key, rules)]
    return alone if alone and not leaves_more_than_noise(state) else []
