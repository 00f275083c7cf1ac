"""Masses of several bodies that are off at once, beside instruments that are not exact.

Findings are made one by one.  Where two masses are wrong, a spring to the ground, an air spring or a gain may fit
better than either mass alone, though both masses together fit better than any of them.  Masses are what a system file
is most often wrong in, so that all of them and the instruments are tried together before another linear part is named.
"""

from __future__ import annotations

from dataclasses import replace

from sprung.model.diagnosis.investigation.calibration import calibrated, of_all_channels
from sprung.model.diagnosis.investigation.minor import is_minor, untried
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.response.terms import evaluated_in_time
from sprung.model.diagnosis.screening.score import Candidate
from sprung.model.diagnosis.selection.compete import Trial, compete, evidence_together
from sprung.model.diagnosis.selection.plausible import doubt
from sprung.model.laws.bodies import MASS_CHANGE

_STEPS = 6  # of the fit of all errors, from the present model


def imitates_errors(state: Investigation, chosen: Trial) -> bool:
    """Whether a linear part has less evidence than other masses and calibration errors have together."""
    if state.calibrations is not None or evaluated_in_time(chosen.term) or chosen.term.law is MASS_CHANGE:
        return False
    masses = (replace(candidate.term, parameters=MASS_CHANGE.absent) for candidate in _masses(state))
    errors = (*masses, *of_all_channels(state))
    return evidence_together(state.problem, state.fit, errors, _STEPS) > chosen.evidence


def with_errors_instead(state: Investigation, chosen: Trial) -> tuple[Investigation, Trial]:
    """The best mass in the place of a chosen trial; without any, the investigation with all calibration errors."""
    trials = (trial for trial in compete(state.problem, state.fit, _masses(state)) if trial.finished)
    mass = next((trial for trial in trials if trial.evidence > 0 and _is_plausible(state, trial)), None)
    return (calibrated(state, chosen.term), chosen) if mass is None else (state, mass)


def _is_plausible(state: Investigation, trial: Trial) -> bool:
    rules = state.options.rules.plausible
    return doubt(trial.fit, trial.term, rules, before=state.fit) is None and not is_minor(state, trial)


def _masses(state: Investigation) -> list[Candidate]:
    """Masses that are not among the findings."""
    return [one for one in untried(state, state.last.candidates) if one.term.law is MASS_CHANGE]
