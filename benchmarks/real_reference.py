"""What one would fit by hand: linear and plain Bouc-Wen models of a component test by SciPy, with the same split."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
STARTS = ((0.003, 0.05), (0.03, 0.3), (0.3, 0.3))  # yield displacement over travel, force over the measured


def linear(displacement: Array, rate: Array, force: Array, split: int) -> Array:
    """Preload, spring and damper by least squares on the first `split` samples; the force over all."""
    columns = np.column_stack([np.ones(len(force)), displacement, rate])
    found: Array = columns @ np.linalg.lstsq(columns[:split], force[:split], rcond=None)[0]
    return found


def bouc_wen(displacement: Array, rate: Array, force: Array, split: int) -> Array:
    """z' = v - beta (abs(v) z + v abs(z) / 2) beside preload, spring and damper, from the best of several starts."""
    travel, size = 0.5 * float(np.ptp(displacement)), float(np.std(force))
    ways = np.diff(displacement)

    def memory(reach: float) -> Array:
        z, path = 0.0, np.zeros(len(displacement))
        beta = 1 / (1.5 * reach)
        for i, way in enumerate(ways.tolist()):
            parts = max(1, int(abs(way) / (0.2 * reach)) + 1) if abs(way) < 20 * reach else 100
            for _ in range(parts):
                step = way / parts
                z += step - beta * (abs(step) * z + 0.5 * step * abs(z))
            z = min(max(z, -reach), reach)
            path[i + 1] = z
        return path / reach

    def columns(x: Array) -> Array:
        return np.column_stack([np.ones(len(force)), displacement, rate, memory(travel * float(np.exp(x[0])))])

    def solved(x: Array) -> Array:
        of = columns(x)
        return of @ np.linalg.lstsq(of[:split], force[:split], rcond=None)[0]

    fits = [
        least_squares(lambda x: (solved(x) - force)[:split] / size, np.log([reach]), diff_step=1e-3, max_nfev=25)
        for reach, _ in STARTS
    ]
    return solved(min(fits, key=lambda fit: fit.cost).x)
