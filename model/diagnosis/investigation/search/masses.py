"""Masses of several bodies that are off at once, beside instruments that are not exact.

Findings are made one by one.  Where two masses are wrong, a spring to the ground, an air spring or a gain may fit
better than either mass alone, though both masses together fit better than any of them.  Masses are what a system file
is most often wrong in, so that all of them and the instruments are tried together before another linear part is named.
"""

from __future__ import annotations

from sprung.model.diagnosis.investigation.measurements.data_sheets import calibration_terms
from sprung.model.diagnosis.investigation.state import Investigation
from sprung.model.diagnosis.selection.compete import Trial, gain_together

_STEPS = 6  # of the fit of all errors, from the present model


def imitates_errors(state: Investigation, chosen: Trial) -> bool:
    """Whether a linear part explains less than other masses and calibration errors together.

    These are not charged for what they are: they exist on every rig, only their sizes are unknown.
    """
    law = chosen.term.law
    if state.calibrations is not None or law.in_time or law.error_of_value:  # with it, all together explain more
        return False
    found = {term.key for term in state.fit.point.terms}
    errors = [term for term in calibration_terms(state) if term.key not in found]
    by_chance = state.options.rules.screening.per_freedom * len(errors)
    return gain_together(state.problem, state.fit, errors, _STEPS) - by_chance > chosen.evidence
