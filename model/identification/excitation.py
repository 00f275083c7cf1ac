"""Synthetic running records: measured inputs as track (or random forces) give them, responses in steady state.

Vertical track irregularity after ERRI B176: S(W) = b0 / (W^4 + 0.6803895 W^2 + 0.00028855) m^2/(rad/m), W the
wave number in rad/m.  Every realisation is periodic in `_PERIOD` seconds, so displacements, velocities and the
vehicle's response are exact sums of harmonics: no interpolation and no time integration is involved, which makes
these records an independent check of the simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sprung.model.identification.likelihood.frequency import FrequencyModel
from sprung.model.schema import ForceInput
from sprung.model.signals import FloatArray
from sprung.model.simulate.drives import drives_of
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import System

ERRI_LOW, ERRI_HIGH = 2.741619e-7, 7.343623e-7  # b0
_PERIOD = 8.0  # s
_BAND = (0.5, 20.0)  # Hz, where measured axle-box motion carries signal
_RIGID = 1e-3  # Hz; slower modes are bodies that no spring holds
_ABOVE_NOISE = 300.0  # sensors over their noise under a measured force: what makers of modal tests aim at


@dataclass(frozen=True, slots=True)
class Runs:
    """Simulated running records."""

    values: FloatArray  # with measurement noise, shape (B, T, C)
    clean: FloatArray  # without, shape (B, T, C)
    log_ratio: FloatArray  # truth, shape (B, P)


def track_spectrum(wave_number: FloatArray, roughness: float = ERRI_LOW) -> FloatArray:
    """ERRI B176 vertical power spectral density (F,), m^2/(rad/m), of wave numbers (F,) in rad/m."""
    return roughness / (wave_number**4 + 0.6803895 * wave_number**2 + 0.00028855)


def draw_log_ratios(system: System, count: int, spread: float, rng: np.random.Generator) -> FloatArray:
    """Parameters drawn evenly within nominal (1 +- spread), as log-ratios (count, P)."""
    return np.log(rng.uniform(1 - spread, 1 + spread, (count, len(system.parameters))))


def simulate_runs(
    system: System,
    log_ratio: FloatArray,
    samples: int,
    rng: np.random.Generator,
    speed: tuple[float, float] = (40.0, 50.0),
    roughness: tuple[float, float] = (ERRI_LOW, ERRI_LOW),
) -> Runs:
    """One record of `samples` for each parameter vector (B, P), each with its own track, speed (m/s) and phase.

    Left and right rails share half of their power; every wheel of a rail sees it after its own delay.  Forces are
    white over the modes of the system (`_force_band`), and lift the sensors far above their noise.
    """
    B = len(log_ratio)
    fs = system.sample_rate
    period = max(_PERIOD, 2.0 ** np.ceil(np.log2(samples / fs)))
    size = round(period * fs)
    band = _BAND if fs >= 50 else (0.005 * fs, 0.2 * fs)
    of_forces = _force_band(system, band)
    bins = np.arange(max(1, int(min(band[0], of_forces[0]) * period)), int(max(band[1], of_forces[1]) * period) + 1)
    omega = 2 * np.pi * bins / period
    speeds = rng.uniform(*speed, B)
    level = roughness[0] * (roughness[1] / roughness[0]) ** rng.random(B)
    frequency = FrequencyModel(LinearSimulator(system), omega)
    drives = _drive_spectra(frequency, (band, of_forces), speeds, level, 2 * np.pi / period, rng)  # (B, F, W/2)
    values = frequency.simulator.element_values(torch.as_tensor(log_ratio))
    out = (frequency.response(values) @ torch.as_tensor(drives).unsqueeze(3)).squeeze(3)
    columns: Tensor = torch.zeros(B, len(bins), len(system.channels), dtype=out.dtype)
    for i, drive in enumerate(drives_of(system)):
        for order, column in drive.columns.items():
            columns[:, :, column] = torch.as_tensor((1j * omega) ** order * drives[:, :, i])
    columns[:, :, len(system.inputs) :] = out
    spectrum = torch.zeros(B, size // 2 + 1, columns.shape[2], dtype=columns.dtype)
    spectrum[:, bins] = columns
    clean = torch.fft.irfft(spectrum, n=size, dim=1).numpy()[:, :samples] * (size / 2)
    noise = np.array([channel.noise for channel in system.channels])
    return Runs(clean + noise * rng.standard_normal(clean.shape), clean, log_ratio)


Band = tuple[float, float]  # Hz


def _drive_spectra(
    frequency: FrequencyModel,
    bands: tuple[Band, Band],
    speeds: FloatArray,
    level: FloatArray,
    step: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Complex amplitudes of every drive, (B, F, drives): sum of cosines of power S(omega) d omega each.

    bands: of supports and of forces.
    """
    system, omega = frequency.simulator.system, frequency.omega.numpy()
    B, F = len(speeds), len(omega)
    of_supports, of_forces = ((omega >= 2 * np.pi * low) & (omega <= 2 * np.pi * high) for low, high in bands)

    def phases(count: int) -> np.ndarray:
        found: np.ndarray = np.exp(2j * np.pi * rng.random((B, F, count)))
        return found

    wave = omega[None, :] / speeds[:, None]
    amplitude = np.sqrt(2 * track_spectrum(wave, 1.0) * level[:, None] / speeds[:, None] * step) * of_supports
    both, left, right = np.moveaxis(phases(3), 2, 0)
    rails = {1: (both + left) / np.sqrt(2), -1: (both + right) / np.sqrt(2)}
    drives = np.empty((B, F, len(system.file.inputs)), dtype=complex)
    scale = _force_scale(frequency, of_forces)
    for i, (name, source) in enumerate(system.file.inputs.items()):
        if isinstance(source, ForceInput):
            drives[:, :, i] = scale * np.sqrt(2 / of_forces.sum()) * phases(1)[:, :, 0] * of_forces
            continue
        x, y = _position(system, name)
        rail = rails[1 if y >= 0 else -1]
        drives[:, :, i] = amplitude * rail * np.exp(1j * wave * x)
    return drives


def _position(system: System, support: str) -> tuple[float, float]:
    for element in system.file.elements.values():
        if support in (element.upper, element.lower) and element.position is not None:
            return element.position
    return (0.0, 0.0)


def _force_band(system: System, band: Band) -> Band:
    """The band of measured forces: from half the slowest to above the fastest elastic mode, within what the rate shows.

    Without measured forces, and where no spring holds anything, it is that of the supports.
    """
    modes = [mode.frequency for mode in system.mechanics.modes(system.bodies) if mode.frequency > _RIGID]
    if not modes or not any(isinstance(source, ForceInput) for source in system.file.inputs.values()):
        return band
    return min(band[0], modes[0] / 2), min(max(band[1], 1.3 * modes[-1]), 0.4 * system.sample_rate)


def _force_scale(frequency: FrequencyModel, audible: NDArray[np.bool_]) -> float:
    """Root mean square of white forces (N) that half of the sensors show at `_ABOVE_NOISE` times their noise."""
    system = frequency.simulator.system
    forces = frequency.simulator.forces.numpy() // 2
    if not len(forces):
        return 1.0
    values = frequency.simulator.element_values(torch.zeros(1, len(system.parameters), dtype=torch.float64))
    response = frequency.response(values)[0].numpy()[audible][:, :, forces]  # (F, S, forces)
    shown = np.sqrt((np.abs(response) ** 2).sum(axis=2).mean(axis=0))
    noise = system.sensor_noise
    seen = (shown > 0) & (noise > 0)
    return _ABOVE_NOISE * float(np.median(noise[seen] / shown[seen])) if seen.any() else 1.0
