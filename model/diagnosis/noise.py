"""Noise levels, estimated: of inputs from their redundancy, of sensors from what neither model nor neighbours explain.

Physics that was left out is concentrated in some bands and sensors, noise is white: the level of a sensor is the
median over frequency blocks, so that the misfit of a missing law does not pass for noise.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from model.diagnosis.fit import Whitener
from model.diagnosis.forward import Forward
from model.diagnosis.measured import Noise, Part
from model.diagnosis.spectra import ComplexArray
from model.signals import FloatArray

_BLOCKS = 24
_ROUNDS = 4


def input_noise(part: Part, noise: Noise) -> Noise:
    """Levels of displacement and velocity channels from V / j w - D, by Fisher scoring per support.

    What of the difference is a copy of the motion or of its derivative (a wrong gain, a lag) is taken out first.
    """
    band = part.grid.band
    omega = part.grid.omega[band]
    displacement, velocity = noise.displacement.copy(), noise.velocity.copy()
    for at, support in enumerate(part.pairs):
        levels = np.array([displacement[support] ** 2, velocity[support] ** 2])
        weights = np.stack([np.ones(len(omega) - 1), 1 / omega[1:] ** 2])  # variance per bin = levels @ weights
        difference = part.redundancy[band, at][1:]
        motion = part.support[band, support][1:]
        for _ in range(8):
            variance = levels @ weights
            regressors = np.stack([motion, 1j * omega[1:] * motion], axis=1) / np.sqrt(variance)[:, None]
            target = difference / np.sqrt(variance)
            both = np.concatenate([regressors.real, regressors.imag])
            taken = np.linalg.lstsq(both, np.concatenate([target.real, target.imag]), rcond=None)[0]
            rest = np.abs(target - regressors @ taken) ** 2  # mean 1 at the truth
            relative = weights / variance
            score = relative @ (rest - 1)
            fisher = relative @ relative.T
            levels = np.maximum(levels + np.linalg.solve(fisher, score), 0.01 * levels)
        displacement[support], velocity[support] = np.sqrt(levels)
    return replace(noise, displacement=displacement, velocity=velocity)


def sensor_noise(forward: Forward, spectrum: ComplexArray, noise: Noise) -> Noise:
    """Levels of the sensors from the residual (F, S) of a fit."""
    band = forward.part.grid.band
    residual = spectrum[band][1:]
    edges = np.linspace(0, len(residual), _BLOCKS + 1).astype(int)
    for _ in range(_ROUNDS):
        factor = Whitener.of(forward, noise).factor[1:]
        precision = factor.conj().transpose(0, 2, 1) @ factor
        alone = np.real(np.einsum("fss->fs", precision))  # 1 / variance given the other sensors
        surprise = np.abs(np.einsum("fst,ft->fs", precision, residual)) ** 2 / alone  # mean 1 at the truth
        blocks = np.array([surprise[a:b].mean(axis=0) for a, b in pairwise(edges)])
        level = _robust(blocks, np.diff(edges))
        own = np.median(1 / alone / noise.sensors**2, axis=0)  # variance given the others over the own variance
        ratio = np.maximum(1 + (level - 1) * own, 0.05)
        noise = replace(noise, sensors=noise.sensors * np.sqrt(ratio))
    return noise


def _robust(blocks: FloatArray, counts: np.ndarray) -> FloatArray:
    """Level over blocks (blocks, S): the mean of those that agree with the quiet half, per sensor."""
    middle = np.median(blocks, axis=0)
    quiet = np.quantile(blocks, 0.3, axis=0)
    spread = 1 / np.sqrt(np.mean(counts))
    base = np.minimum(middle, quiet * (1 + 2 * spread))
    good = blocks <= base * (1 + 4 * spread)
    return np.sum(blocks * good, axis=0) / np.maximum(np.sum(good, axis=0), 1)
