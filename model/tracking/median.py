"""The median of a few values."""

from __future__ import annotations

import numpy as np

from sprung.model.signals import FloatArray


def median(values: FloatArray) -> float:
    """Of a few values (N,), at least one: NumPy's own spends most of its time on what they may be."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half]) if len(values) % 2 else 0.5 * float(ordered[half - 1] + ordered[half])
