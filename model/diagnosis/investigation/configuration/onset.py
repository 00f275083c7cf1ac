"""The sign of a measured force by the first motion that it causes, which needs no model of the structure.

A force first moves its own point in its own direction, whatever the structure is made of: the velocity of the point
after a unit impulse begins at F^T M^-1 F > 0, and never exceeds this value in magnitude afterwards.  If it begins
negative, the sign of the force or of the sensor at its point is reversed.  A delay between the two shows as a later
beginning, and what precedes the impulse is noise.  Below all resonances a force is that of a spring, whose velocity
leads it: within such a band the response swings as far before the impulse as after, and shows no beginning.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import csd, welch

from sprung.model.diagnosis.record.signals import Part
from sprung.model.diagnosis.rules import SetupRules
from sprung.model.mechanics import ACCELERATION, DISPLACEMENT, VELOCITY, Mechanics
from sprung.model.signals import FloatArray

_DERIVATIVES = {DISPLACEMENT: 0, VELOCITY: 1, ACCELERATION: 2}


def driving_point(mechanics: Mechanics) -> int | None:
    """Index of a motion sensor at the point of the only force; None: no such sensor, or other measured inputs."""
    if mechanics.F.shape[1] != 1 or mechanics.G.shape[1]:
        return None
    here = [
        i
        for i, kind in enumerate(mechanics.sensor_kind)
        if kind in _DERIVATIVES and np.allclose(mechanics.S[i], mechanics.F[:, 0])
    ]
    return here[0] if here else None


def begins_backwards(force: FloatArray, velocity: FloatArray, compared: float, rules: SetupRules) -> bool:
    """Whether the response of a point to a force at it begins against that force, significantly.

    force and velocity: (T,), of the point; compared: share of the sample rate up to which spectra are used.
    The impulse response is that of the H1 estimate of the mobility (Bendat and Piersol, Random Data).
    """
    length = len(force) // rules.segments
    if length < 4 * rules.onset:
        return False
    frequency, power = welch(force, nperseg=length)
    _, cross = csd(force, velocity, nperseg=length)
    edge = 0.5 * (1 + np.cos(np.pi * np.clip(frequency / compared, 0, 1)))  # without the ringing of a sharp one
    mobility = edge * cross / (power + rules.unexcited * np.max(power))
    weight = np.abs(mobility) * frequency
    quarter = 0.25 * float(np.sum(np.abs(mobility)) / max(float(np.sum(weight)), 1e-300))  # of a period, in samples
    response = np.roll(np.fft.irfft(mobility, length), length // 2)
    start = length // 2
    early = response[start : start + max(2, int(np.ceil(quarter)))]
    first = float(early[int(np.argmax(np.abs(early)))])
    before = start - int(np.ceil(2 * quarter))
    noise = float(np.sqrt(np.mean(response[:before] ** 2)))
    leading = float(np.max(np.abs(response[before : start - max(1, int(quarter / 2))])))  # later: smeared by the edge
    begins = leading < rules.first * abs(first) and abs(first) > rules.first * float(np.max(np.abs(response)))
    return begins and first < -rules.onset * noise


def velocity_of(part: Part, kind: int, column: int) -> FloatArray:
    """Velocity (T,) by a motion sensor of a kind, without its mean."""
    order = 1 if part.differentiated[column] else _DERIVATIVES[kind]
    found = np.zeros(len(part.grid.omega), dtype=complex)
    band = slice(1, part.grid.band.stop)
    found[band] = part.sensors[band, column] * (1j * part.grid.omega[band]) ** (1 - order)
    return part.grid.inverse(found)
