"""Lags of single sensors that are one: all channels of a node, a kind or the rig late by the same time.

Spectra do not always rank the delay of a node, beside parameters that are far off; the lags of its sensors are then
found one after the other.
"""

from __future__ import annotations

from sprung.model.diagnosis.investigation.configuration.effects import NODE_DELAY, Hypothesis, SetupPlace
from sprung.model.diagnosis.investigation.configuration.hypotheses import Wiring
from sprung.model.diagnosis.investigation.measurements.calibration import faulty
from sprung.model.diagnosis.investigation.state import Investigation


def common_delay(state: Investigation) -> Hypothesis | None:
    """The delay of a group of sensors, if the lag of every one of them was found and they agree; None otherwise."""
    names = list(state.signals.sensor_names)
    terms = state.fit.point.terms
    wrong = [*(terms[index] for index in faulty(state)), *terms[state.given :]]
    late = {names.index(term.location): term.parameters[0] for term in wrong if term.law.delays}
    if len(late) < 2:
        return None
    most = state.options.rules.setup.in_common / state.signals.sample_rate
    wired = Wiring(state.system, state.signals)
    for group in sorted(wired.groups(), key=lambda group: -len(group.sensors)):
        times = [late[i] for i in group.sensors if i in late]
        complete = len(times) == len(group.sensors) > 1 and not group.supports
        if complete and min(times) > 0 and max(times) - min(times) < most:
            return Hypothesis.of(NODE_DELAY, SetupPlace(wired.name(group), group), sum(times) / len(times), 0.0)
    return None
