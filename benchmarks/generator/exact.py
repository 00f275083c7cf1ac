"""Linear vehicles without an integrator: the exact periodic response, bin by bin.

For recordings without a law, an elastic mode or a hidden force.  The track is a sum of harmonics, so the vehicle's
response is one too, and nothing is approximated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import track
from sprung.benchmarks.generator.draw import Case
from sprung.benchmarks.generator.integrate import LOW_PASS, SAMPLE_RATE, STEP_RATE
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class VehicleTransfer:
    """Frequency responses of one vehicle from the wheels to the sensors, and to element motions."""

    def __init__(
        self,
        vehicle: Vehicle,
        stiffness: Array | Complex,
        damping: Array,
        omega: Array,
        inertia: Array | None = None,
    ) -> None:
        """stiffness: (E,), or complex and of every frequency, (F, E)."""
        jw = 1j * omega[:, None]
        impedance = stiffness + jw * damping  # (F, E)
        geometry = vehicle.geometry
        stands = np.zeros((len(vehicle.elements), len(vehicle.inputs)))
        for row, wheel in enumerate(vehicle.support):
            if wheel >= 0:
                stands[row, wheel] = 1.0
        dynamic = np.einsum("ei,fe,ej->fij", geometry, impedance, geometry) - np.einsum(
            "f,ij->fij", omega**2, np.diag(vehicle.inertia if inertia is None else inertia)
        )
        idle = ~geometry.any(axis=0)  # what a body cannot do
        dynamic[:, idle, idle] += 1.0
        self.compliance = np.linalg.inv(dynamic)  # displacement per generalised force, (F, D, D)
        drive = np.einsum("ei,fe,ew->fiw", geometry, impedance, stands)
        motion = self.compliance @ drive  # (F, D, wheels)
        felt = -(omega**2)[:, None, None] * vehicle.pickup
        self.to_sensors = felt @ motion
        self.stretch = geometry @ motion - stands  # deflection per wheel displacement, (F, E, wheels)
        self.load_to_sensors = felt @ self.compliance @ (-geometry.T)  # per element force, (F, S, E)


def is_linear(case: Case) -> bool:
    """Whether the vehicle of a case is linear and driven by its wheels alone."""
    return not (case.effects or case.flex or case.drive)


def exact_response(vehicle: Vehicle, case: Case, seconds: float) -> Array:
    """Filtered true signals at 100 Hz: displacements, velocities, sensors, shape (T, C)."""
    spectra, omega, samples = track.wheel_spectra(
        np.random.default_rng(case.seed + 2),
        seconds,
        case.speed,
        case.level,
        vehicle.input_position,
        vehicle.input_side,
        joint_spacing=case.joints,
    )
    values = [np.array([v[e] for e in vehicle.elements]) for v in (case.stiffness, case.damping)]
    inertia = vehicle.inertia.copy()
    if case.mass_scale:
        inertia[vehicle.on_body(case.mass_scale[0])] *= case.mass_scale[1]
    live = np.flatnonzero(omega < 2 * np.pi * 50.0)  # nothing on the track is faster
    stiffness = np.tile(values[0].astype(complex), (len(live), 1))  # (F, E)
    if case.rubber:
        element, size, order = case.rubber
        stiffness[:, vehicle.elements.index(element)] += size * (1j * omega[live] / (2 * np.pi)) ** order
    transfer = VehicleTransfer(vehicle, stiffness, values[1], omega[live], inertia)
    return filtered(transfer, spectra[live], omega[live], samples, seconds, (0, 1))


def filtered(
    transfer: VehicleTransfer, spectra: Complex, omega: Array, samples: int, seconds: float, orders: tuple[int, ...]
) -> Array:
    """What is recorded at 100 Hz behind the low-pass: the derivatives `orders` of all wheels, then the sensors, (T, C).

    spectra: displacements of the wheels at omega, (F, wheels), bins 0, 1, ... of a period of `samples` at 1 kHz.
    """
    reach = np.arange(LOW_PASS.size) - LOW_PASS.size // 2
    passed = np.cos(omega[:, None] * reach / STEP_RATE) @ LOW_PASS
    felt = np.einsum("fsw,fw->fs", transfer.to_sensors, spectra)
    moved = [(1j * omega[:, None]) ** order * spectra for order in orders]
    every = np.concatenate([*moved, felt], axis=1) * passed[:, None]
    padded = np.zeros((samples // 2 + 1, every.shape[1]), complex)
    padded[: len(every)] = every
    step = int(track.RATE / SAMPLE_RATE)
    series: Array = np.fft.irfft(padded, samples, axis=0)[::step][: int(np.ceil(seconds * SAMPLE_RATE))]
    return series
