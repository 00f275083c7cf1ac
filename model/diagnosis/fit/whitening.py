"""Whitening of residuals by their covariance: noise of the sensors, and of the inputs through the plant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sprung.model.diagnosis.record.signals import Noise, Part
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.signals import FloatArray


@dataclass(frozen=True)
class Whitener:
    """Inverse Cholesky factors of the residual's covariance on the compared bins."""

    factor: ComplexArray  # (F, S, S)
    smoother_gain: ComplexArray  # from whitened residual to input noise, supports then forces, (F, inputs, S)
    weight: FloatArray  # of the bins among real numbers, (F,)

    @property
    def log_det(self) -> float:
        """Logarithm of the covariance's determinant, of all real numbers together."""
        size = np.abs(np.einsum("fss->fs", self.factor))
        return -2 * float(self.weight**2 @ np.sum(np.log(size), axis=1))

    def log_det_slope(self, change: ComplexArray) -> float:
        """Derivative of `log_det` along a change (F, S, inputs) of the response to the inputs."""
        return 2 * float(np.real(np.dot(self._weighted_gain, change.ravel())))

    @cached_property
    def _weighted_gain(self) -> ComplexArray:
        """Gain from residual to input noise, weighted by bin, in the order of a change's values, (F * S * inputs,)."""
        gain = self.smoother_gain @ self.factor * self.weight[:, None, None] ** 2
        return np.asarray(gain.transpose(0, 2, 1).ravel())

    @classmethod
    def of(cls, forward: Forward, noise: Noise) -> Whitener:
        """Covariance from the sensors' noise and from the inputs' noise through the model."""
        part = forward.part
        band = part.grid.band
        G = forward.of_inputs[band]
        variance = noise.support_variance(part.grid.omega[band])
        variance = np.concatenate([variance, np.broadcast_to(noise.force**2, (len(G), len(noise.force)))], axis=1)
        weighted = G * variance[:, None, :]
        R = weighted @ G.conj().transpose(0, 2, 1)
        index = np.arange(R.shape[1])
        R[:, index, index] += noise.sensor_variance(part.grid, part.differentiated)[band]
        factor = np.linalg.inv(np.linalg.cholesky(R))
        return cls(factor, (factor @ weighted).conj().transpose(0, 2, 1), part.grid.weight)

    def __call__(self, spectrum: ComplexArray, part: Part) -> FloatArray:
        """(F, S) or (F, S, m) -> real unit-noise vectors (2 F S,) or (2 F S, m)."""
        return part.grid.pack(self.whitened(spectrum, part))

    def whitened(self, spectrum: ComplexArray, part: Part) -> ComplexArray:
        """The compared bins of (F', S) or (F', S, m) in units of noise, (F, S) or (F, S, m)."""
        band = spectrum[part.grid.band]
        return (self.factor @ band[:, :, None])[:, :, 0] if band.ndim == 2 else self.factor @ band
