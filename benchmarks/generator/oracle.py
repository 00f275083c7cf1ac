"""What the best possible test could see: the signal-to-noise ratio of an effect whose place and law are known.

The oracle is told everything but the vehicle's own stiffnesses and dampings: it sees the deviation that the effect
causes in the sensors, takes away what the other parameters could imitate, and whitens by the sensors' noise and the
inputs' noise through the vehicle,

    R = diag(s^2) + G diag(1 / (1/s_d^2 + w^2/s_v^2)) G^H,        snr^2 = | (I - P) R^-1/2 delta |^2.

Its likelihood ratio exceeds the threshold z^2 of a chosen false-alarm rate in half of all recordings when snr = z, so
the strength at its detection limit is the given strength times z / snr.  Computed from the noise-free truth in the
frequency domain with an own transfer matrix.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator.draw import Case
from sprung.benchmarks.generator.exact import VehicleTransfer
from sprung.benchmarks.generator.integrate import SAMPLE_RATE
from sprung.benchmarks.generator.vehicle import Vehicle

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

BLEND = 4.0  # s of smooth return that make a record periodic
SETTLE = 15.0  # s at the start in which the assumed past still rings
TOP = 40.0  # Hz: below the anti-aliasing filter's edge


def _periodic(x: Array) -> Array:
    """The record continued by a cubic that leads from its end back to its start, value and slope."""
    n = int(BLEND * SAMPLE_RATE)
    u = (np.arange(1, n + 1) / (n + 1))[:, None]
    slope_end, slope_start = (x[-1] - x[-3]) / 2 * (n + 1), (x[2] - x[0]) / 2 * (n + 1)
    bridge = (
        x[-1] * (2 * u**3 - 3 * u**2 + 1)
        + slope_end * (u**3 - 2 * u**2 + u)
        + x[0] * (3 * u**2 - 2 * u**3)
        + slope_start * (u**3 - u**2)
    )
    return np.vstack([x, bridge])


def _sensitivities(transfer: VehicleTransfer, wheels: Complex, omega: Array) -> Complex:
    """Response of the sensors to a relative change of every stiffness and damping (unscaled), (F, S, 2 E)."""
    deflection = np.einsum("few,fw->fe", transfer.stretch, wheels)
    by_stiffness = transfer.load_to_sensors * deflection[:, None, :]
    return np.concatenate([by_stiffness, by_stiffness * (1j * omega)[:, None, None]], axis=2)


def _windowed_spectrum(series: Array, keep: slice) -> Complex:
    """FFT of the settled part under a Hann-edged window, scaled to unit variance per unit white noise."""
    part = series[keep]
    n = len(part)
    edge = int(0.04 * n)
    taper = np.ones(n)
    taper[:edge] = 0.5 - 0.5 * np.cos(np.pi * np.arange(edge) / edge)
    taper[-edge:] = taper[:edge][::-1]
    shape = (n,) + (1,) * (part.ndim - 1)
    spectrum: Complex = np.fft.rfft(part * taper.reshape(shape), axis=0) / np.sqrt(np.sum(taper**2))
    return spectrum


class OracleTest:
    """What the best test makes of deviations in one recording; clean: its true filtered signals, (T, channels)."""

    def __init__(self, vehicle: Vehicle, case: Case, clean: Array) -> None:
        self.wheels = wheels = len(vehicle.inputs)
        periodic = _periodic(clean[:, :wheels])
        omega_full = np.asarray(2 * np.pi * np.fft.rfftfreq(len(periodic), 1 / SAMPLE_RATE), dtype=np.float64)
        values = (np.array([found[e] for e in vehicle.elements]) for found in (case.stiffness, case.damping))
        stiffness, damping = values
        full = VehicleTransfer(vehicle, stiffness, damping, omega_full)
        spectrum = np.fft.rfft(periodic, axis=0)

        def back(values: Complex) -> Array:
            result: Array = np.fft.irfft(values, len(periodic), axis=0)[: len(clean)]
            return result

        self.linear = back(np.einsum("fsw,fw->fs", full.to_sensors, spectrum))
        self.keep = slice(int(SETTLE * SAMPLE_RATE), len(clean))
        n = len(clean[self.keep])
        frequency = np.fft.rfftfreq(n, 1 / SAMPLE_RATE)
        self.band = (frequency > 0) & (frequency < TOP)
        self.omega = np.asarray(2 * np.pi * frequency[self.band], dtype=np.float64)
        self.there = VehicleTransfer(vehicle, stiffness, damping, self.omega)
        self.s_d, self.s_v = vehicle.input_noise
        # of the fused displacement, (F, wheels)
        self.variance = 1 / (1 / self.s_d**2 + (self.omega[:, None] / self.s_v) ** 2)
        seen = self.there.to_sensors
        noise = np.einsum("fsw,fw,ftw->fst", seen, self.variance, seen.conj()) + np.diag(vehicle.sensor_noise**2)
        self.whiten = np.linalg.inv(np.linalg.cholesky(noise))
        self.columns = self.spectrum(back(_sensitivities(full, spectrum, omega_full)))
        self.share = len(clean) / n  # the settling part would have told as much per second

    def spectrum(self, series: Array) -> Complex:
        """Of series (T, ...) within the band, (F, ...)."""
        found: Complex = _windowed_spectrum(series, self.keep)[self.band]
        return found

    def square(self, delta: Complex, beside: Sequence[Complex] = ()) -> float:
        """snr^2 of a deviation of the sensors (F, S) that neither parameters nor the deviations `beside` imitate."""
        flat = (self.whiten @ delta[:, :, None]).ravel()
        columns = np.concatenate([self.columns, *[other[:, :, None] for other in beside]], axis=2)
        matrix = (self.whiten @ columns).reshape(flat.size, -1)
        left = np.concatenate([flat.real, flat.imag])
        stacked = np.vstack([matrix.real, matrix.imag]) / (np.linalg.norm(matrix, axis=0) + 1e-300)
        basis, _ = np.linalg.qr(stacked)
        left = left - basis @ (basis.T @ left)
        return float(2 * self.share * (left @ left))


def oracle_snr(vehicle: Vehicle, case: Case, clean: Array, faulty: Array) -> float | None:
    """The signal-to-noise ratio of the case's concealed effects together; None where no oracle is defined.

    `clean` are the true filtered signals, `faulty` the same with a sensor's fault and no noise; both (T, channels) in
    the order displacements, velocities, sensors.
    """
    if case.fault and case.fault[1] in {"sensor_noise", "sensor_stuck"}:
        return None
    test = OracleTest(vehicle, case, clean)
    wheels, omega = test.wheels, test.omega
    delta = test.spectrum(faulty[:, 2 * wheels :] - test.linear)
    extra = 0.0
    if case.fault and (faulty[:, : 2 * wheels] != clean[:, : 2 * wheels]).any():
        wrong = test.spectrum(faulty[:, : 2 * wheels] - clean[:, : 2 * wheels])
        shifted = wrong[:, :wheels] / test.s_d**2 + wrong[:, wheels:] * omega[:, None] / test.s_v**2 / 1j
        delta = delta - np.einsum("fsw,fw->fs", test.there.to_sensors, shifted * test.variance)
        contradiction = wrong[:, wheels:] / (1j * omega[:, None]) - wrong[:, :wheels]
        extra = 2 * float(np.sum(np.abs(contradiction) ** 2 / (test.s_d**2 + (test.s_v / omega[:, None]) ** 2)))
    return float(np.sqrt(test.square(delta) + extra * test.share))


def snr_of_each(vehicle: Vehicle, case: Case, clean: Array, without: Sequence[Array]) -> list[float]:
    """The ratio of every law beside the others; without: the true signals where one of them is missing."""
    test = OracleTest(vehicle, case, clean)
    sensors = slice(2 * test.wheels, None)
    deltas = [test.spectrum(clean[:, sensors] - one[:, sensors]) for one in without]
    return [float(np.sqrt(test.square(own, deltas[:i] + deltas[i + 1 :]))) for i, own in enumerate(deltas)]
