"""Rails under a running vehicle: ERRI B176 irregularity, optional joints, wheels delayed by their position.

Every wheel's displacement and velocity are evaluated from one sum of harmonics per rail, so that the delay between
axles and the derivative are exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RATE = 1000.0  # Hz, grid on which wheels are tabulated (band below 45 Hz)
LOW_TRACK = 2.741619e-7  # b0 of ERRI B176, vertical, low level
HIGH_TRACK = 7.343623e-7
LONGEST, SHORTEST = 0.07, 3.25  # rad/m, band of the irregularity
TOP_FREQUENCY = 42.0  # Hz: nothing faster reaches the wheels


def errib176(wavenumber: Array, level: float) -> Array:
    """One-sided spectrum in m^2/(rad/m): b0 / (W^4 + 0.6803895 W^2 + 0.00028855)."""
    square = wavenumber**2
    return level / (square**2 + 0.6803895 * square + 0.00028855)


def _rail_spectrum(rng: np.random.Generator, samples: int, speed: float, level: float) -> NDArray[np.complex128]:
    """Random harmonics of one profile over time, shape (samples // 2 + 1,), scaled for `irfft`."""
    frequency: Array = np.fft.rfftfreq(samples, 1 / RATE).astype(np.float64)
    wavenumber = 2 * np.pi * frequency / speed
    density = errib176(wavenumber, level) * 2 * np.pi / speed  # m^2/Hz
    edge = 1 / (1 + (LONGEST / np.maximum(wavenumber, 1e-9)) ** 16)
    band = edge * (wavenumber <= SHORTEST) * (frequency < TOP_FREQUENCY)
    amplitude = np.sqrt(density * band * RATE * samples / 2)
    phase = rng.normal(size=frequency.size) + 1j * rng.normal(size=frequency.size)
    found: NDArray[np.complex128] = amplitude * phase / np.sqrt(2)
    return found


def _joints(rng: np.random.Generator, samples: int, speed: float, spacing: float) -> NDArray[np.complex128]:
    """Dipped joints at even spacing, on both rails alike: a smooth V about a metre wide and millimetres deep."""
    place = np.arange(samples) * speed / RATE
    offset, depth, width = rng.uniform(0, spacing), rng.uniform(2e-3, 5e-3), rng.uniform(0.3, 0.6)
    gap = (place - offset + spacing / 2) % spacing - spacing / 2
    dip = np.fft.rfft(-depth * np.exp(-np.abs(gap) / width))
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    found: NDArray[np.complex128] = dip / np.sqrt(1 + (frequency / 25.0) ** 12) * (frequency < 49.0)
    return found


def wheel_spectra(
    rng: np.random.Generator,
    seconds: float,
    speed: float,
    level: float,
    position: Array,
    side: Array,
    correlation: float = 0.5,
    joint_spacing: float | None = None,
    own_share: float = 0.0,
) -> tuple[NDArray[np.complex128], Array, int]:
    """Displacement of every wheel as harmonics of a period that is longer than `seconds`.

    own_share: part of every wheel's power that no other wheel sees.

    Returns `irfft` coefficients on the grid of 1 kHz (F, wheels), angular frequencies (F,) and the period's samples.
    """
    samples = int(2 ** np.ceil(np.log2(seconds * RATE + 2000)))
    common, left, right = (_rail_spectrum(rng, samples, speed, level) for _ in range(3))
    own = np.sqrt(1 - correlation)
    shared = np.sqrt(correlation)
    rails = {1.0: shared * common + own * left, -1.0: shared * common + own * right}
    if joint_spacing is not None:
        dips = _joints(rng, samples, speed, joint_spacing)
        rails = {key: value + dips for key, value in rails.items()}
    omega = np.asarray(2 * np.pi * np.fft.rfftfreq(samples, 1 / RATE), dtype=np.float64)
    delayed = [
        rails[float(y)] * np.exp(-1j * omega * (position.max() - x) / speed)
        for x, y in zip(position, side, strict=True)
    ]
    if own_share > 0:
        alone = (_rail_spectrum(rng, samples, speed, level) for _ in delayed)
        delayed = [np.sqrt(1 - own_share) * d + np.sqrt(own_share) * a for d, a in zip(delayed, alone, strict=True)]
    return np.stack(delayed, axis=1), omega, samples


def wheels(
    rng: np.random.Generator,
    seconds: float,
    speed: float,
    level: float,
    position: Array,
    side: Array,
    correlation: float = 0.5,
    joint_spacing: float | None = None,
) -> tuple[Array, Array]:
    """Displacement (m) and velocity (m/s) under every wheel on a grid of 1 kHz, each of shape (N, wheels)."""
    spectra, omega, samples = wheel_spectra(rng, seconds, speed, level, position, side, correlation, joint_spacing)
    count = int(np.ceil(seconds * RATE)) + 2
    displacement = np.fft.irfft(spectra, samples, axis=0)[:count]
    velocity = np.fft.irfft(1j * omega[:, None] * spectra, samples, axis=0)[:count]
    return displacement, velocity
