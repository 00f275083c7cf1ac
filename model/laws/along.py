"""Forces of laws along whole trajectories: in one call, by a law's own path, or step by step."""

from __future__ import annotations

import numpy as np

from sprung.model.laws import CLOCK_LEAD, ElementLaw, Motion, SpringDamper
from sprung.model.laws.trajectory import along
from sprung.model.signals import FloatArray


def force_along(
    law: ElementLaw,
    parameters: tuple[float, ...],
    deflection: FloatArray,
    rate: FloatArray,
    time: FloatArray,
    element: SpringDamper,
) -> FloatArray:
    """Force of a law, N, along deflection and rate (T,) at times (T,) in s since the start of the recording."""
    if law.memory == 0:
        return np.asarray(law.force(Motion(deflection, rate, time + CLOCK_LEAD), parameters, element))
    if law.path is not None:
        return law.path(Motion(deflection, rate, time + CLOCK_LEAD), parameters)
    step = time[1] - time[0]
    return along(law, parameters, deflection, rate, sample_rate=1 / step, element=element, start=time[0] + CLOCK_LEAD)
