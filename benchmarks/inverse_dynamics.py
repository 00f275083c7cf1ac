"""What a model of a slide on a guide says of the force that a measured motion needs: inverse dynamics.

    F = M a + c v + F_c sign(v) + offset,

with rate and acceleration from the measured position, and both sides behind the same low pass.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from sprung.model.signals import FloatArray

PASSED = 15.0  # Hz: above it the encoder's steps, twice differentiated, are louder than the motion
STILL = 1e-4  # m/s: slower, friction has no direction
ENDS = 0.2  # s, that the filter does not know


def force_error(force: FloatArray, position: FloatArray, rate: float, values: Mapping[str, float]) -> float:
    """Root mean square of the force (N) that a model does not explain, of force and position (T,) at `rate` Hz.

    values: mass kg, viscous N s/m, coulomb N and offset N; what is missing is none.
    """
    curve = CubicSpline(np.arange(len(position)) / rate, position)
    v, a = (curve(curve.x, order) for order in (1, 2))
    sliding = np.sign(v) * (np.abs(v) > STILL)
    modelled = values.get("mass", 0.0) * a + values.get("viscous", 0.0) * v
    modelled = modelled + values.get("coulomb", 0.0) * sliding + values.get("offset", 0.0)
    left = sosfiltfilt(butter(2, PASSED, fs=rate, output="sos"), force - modelled)
    ends = int(ENDS * rate)
    return float(np.sqrt(np.mean(left[ends:-ends] ** 2)))
