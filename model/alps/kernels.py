"""Neural tangent kernels of the estimator on four feature maps of a window (section 5 of the paper, Fig. 3).

The tangent kernel of an infinitely wide ReLU network follows from its inputs' scalar products alone (Jacot et al.
2018; closed form of Cho and Saul 2009):

    S0 = <a, b>,  S_{l+1} = sqrt(q_a q_b) (sin t + (pi - t) cos t) / pi,  K_{l+1} = K_l (pi - t) / pi + S_{l+1}

with q the squared norms, cos t = S_l / sqrt(q_a q_b), K_0 = S_0.  Composed with a feature map phi it is
K(phi(v1), phi(v2)).  Scaling of phi only scales the kernel, so every kernel is shown divided by its largest value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FREQUENCIES = (25.0, 17.5, 11.0, 7.7, 2.0, 1.0)  # Hz, the paper's six sines
AMPLITUDES = (1.0, 1.2, 1.0, 1.0, 0.4, 1.0)
SAMPLE_RATE = 100.0  # Hz
SAMPLES = 200
WINDOW = 100


def six_sines() -> Array:
    """The paper's signal, (200,); phases are not given and taken as zero."""
    time = np.arange(SAMPLES) / SAMPLE_RATE
    return np.sum([a * np.sin(2 * np.pi * f * time) for f, a in zip(FREQUENCIES, AMPLITUDES, strict=True)], axis=0)


def sliding_windows(signal: Array, window: int = WINDOW) -> Array:
    """All windows, (n - window + 1, window): 101 for the paper's signal."""
    return np.lib.stride_tricks.sliding_window_view(signal, window).copy()


def _dft(windows: Array) -> Array:
    spectrum = np.fft.fft(windows, axis=1)
    return np.concatenate([spectrum.real, spectrum.imag], axis=1)  # <.,.> is the real part of the complex product


FEATURES: dict[str, Callable[[Array], Array]] = {
    "none": lambda windows: windows,
    "k_DFT": _dft,
    "k_MAG": lambda windows: np.abs(np.fft.fft(windows, axis=1)),
    "k_PHA": lambda windows: np.angle(np.fft.fft(windows, axis=1)),
}


def tangent_kernel(features: Array, layers: int = 3) -> Array:
    """NTK (m, m) of a fully connected ReLU network with `layers` hidden layers on features (m, r)."""
    product = features @ features.T
    norm = np.sqrt(np.outer(np.diag(product), np.diag(product)))
    kernel = product.copy()
    for _ in range(layers):
        angle = np.arccos(np.clip(product / norm, -1, 1))
        slope = (np.pi - angle) / np.pi
        product = norm * (np.sin(angle) + (np.pi - angle) * np.cos(angle)) / np.pi
        kernel = kernel * slope + product
    return kernel


@dataclass(frozen=True)
class KernelView:
    """What Fig. 3 shows of one kernel."""

    kernel: Array  # (m, m), largest value 1
    row: Array  # middle row: the kernel over the windows' distance, (m,)
    row_spectrum: Array  # |DFT| of the row without its mean, largest value 1, (m // 2 + 1,)
    eigenvalues: Array  # descending, as shares of their sum, (m,)

    def width(self, share: float = 0.1) -> int:
        """Number of eigenvalues above `share` percent of the largest: directions that are learned in similar time."""
        return int((self.eigenvalues > share / 100 * self.eigenvalues[0]).sum())

    def high_share(self) -> float:
        """Share of the row's spectral power in the upper half of its band."""
        power = self.row_spectrum**2
        return float(power[len(power) // 2 :].sum() / power.sum())


def view(name: str, signal: Array | None = None) -> KernelView:
    """The composed kernel of a feature map on the windows of a signal, the paper's by default."""
    features = FEATURES[name](sliding_windows(six_sines() if signal is None else signal))
    kernel = tangent_kernel(features)
    kernel = kernel / np.abs(kernel).max()
    row = kernel[len(kernel) // 2]
    spectrum = np.abs(np.fft.rfft(row - row.mean()))
    eigenvalues = np.clip(np.linalg.eigvalsh(kernel)[::-1], 0, None)
    return KernelView(kernel, row, spectrum / max(spectrum.max(), 1e-300), eigenvalues / eigenvalues.sum())
