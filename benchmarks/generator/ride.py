"""A linear vehicle on a track that nobody measures: what its accelerometers show.

The response is exact, harmonic by harmonic, as in `exact.py`; here every wheel may also have motion of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.exact import VehicleTransfer
from sprung.benchmarks.generator.integrate import SAMPLE_RATE
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle

Array = NDArray[np.float64]

SYSTEM = Path(__file__).resolve().parents[2] / "model" / "systems" / "manchester.yaml"
ALIASED = 49.0  # Hz, above which nothing may reach a sensor


@dataclass(frozen=True)
class DrawnRide:
    """One vehicle, its load and its track."""

    log_ratio: Array  # of the elements' values to nominal: stiffnesses, then dampings, shape (2 E,)
    load: float  # logarithm of the car's mass and inertias over the nominal ones
    speed: float  # m/s
    level: float  # b0 of the track
    own_share: float  # of each wheel's power that no other wheel sees
    coherence: float  # share of the rails' profiles that both have in common

    def level_at(self, omega: Array) -> Array:
        """Density of a wheel's displacement over frequency, m^2/Hz."""
        wave = omega / self.speed
        return np.asarray(track.errib176(wave, self.level) * 2 * np.pi / self.speed, dtype=np.float64)


def draw_ride(
    rng: np.random.Generator,
    spread: float = 0.3,
    speed: tuple[float, float] = (25.0, 50.0),
    load: tuple[float, float] = (0.85, 1.3),
    own_share: tuple[float, float] = (0.03, 0.2),
) -> DrawnRide:
    """Elements within nominal (1 +- spread), everything else within the ranges given."""
    elements = len(read_vehicle(SYSTEM).elements)
    return DrawnRide(
        log_ratio=np.log(rng.uniform(1 - spread, 1 + spread, 2 * elements)),
        load=float(np.log(rng.uniform(*load))),
        speed=float(rng.uniform(*speed)),
        level=float(np.exp(rng.uniform(np.log(track.LOW_TRACK), np.log(track.HIGH_TRACK)))),
        own_share=float(rng.uniform(*own_share)),
        coherence=float(rng.uniform(0.3, 0.7)),
    )


def transfer(vehicle: Vehicle, ride: DrawnRide, omega: Array) -> VehicleTransfer:
    """Frequency responses of the vehicle as it rides."""
    E = len(vehicle.elements)
    values = np.exp(ride.log_ratio)
    inertia = vehicle.inertia.copy()
    inertia[vehicle.on_body(vehicle.bodies[0])] *= np.exp(ride.load)
    return VehicleTransfer(vehicle, vehicle.stiffness * values[:E], vehicle.damping * values[E:], omega, inertia)


def record(rng: np.random.Generator, ride: DrawnRide, seconds: float) -> Array:
    """Noisy accelerations at 100 Hz of all sensors of the bundled vehicle, shape (T, S)."""
    vehicle = read_vehicle(SYSTEM)
    spectra, omega, samples = track.wheel_spectra(
        rng,
        seconds,
        ride.speed,
        ride.level,
        vehicle.input_position,
        vehicle.input_side,
        ride.coherence,
        own_share=ride.own_share,
    )
    live = np.flatnonzero(omega < 2 * np.pi * ALIASED)
    response = transfer(vehicle, ride, omega[live]).to_sensors
    felt = np.zeros((samples // 2 + 1, len(vehicle.sensors)), complex)
    felt[live] = np.einsum("fsw,fw->fs", response, spectra[live])
    step = int(track.RATE / SAMPLE_RATE)
    clean = np.fft.irfft(felt, samples, axis=0)[::step][: int(seconds * SAMPLE_RATE)]
    return np.asarray(clean + rng.standard_normal(clean.shape) * vehicle.sensor_noise)
